"""Messages gone wrong: golden ones and good inserts, mutated as bytes and as what they mean.  Seeded."""

import random
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import numpy as np

from factorbus.proto import codec
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Insert, Variables

VECTORS = Path(__file__).parents[2] / "proto" / "vectors"
_NUMBERS = (0.0, -0.0, 1e308, -1e308, 5e-324, float("nan"), float("inf"), float("-inf"), 1e16, 1e-300, -1.0)
_INTEGERS = (0, 1, -1, 255, 2**31, 2**32, 2**63 - 1, 2**63, 2**64 - 1, -(2**63), 257, 65536)
_THINGS: tuple[Any, ...] = (
    None, True, b"", b"\0" * 7, "", "se2", "x" * 300, [], {}, [[]], {"a": {}}, 0.5, [1, 2], [None] * 300,
)  # fmt: skip


def golden() -> list[bytes]:
    """Every golden message."""
    return [path.read_bytes() for path in sorted(VECTORS.rglob("*.msgpack"))]


def good_insert(random_: random.Random, have: int) -> Batch:
    """A batch that a map with poses 0 .. have - 1 of a chain takes."""
    count = random_.choice((1, 1, 1, 2, 5))
    first = max(have, 1)
    keys = np.arange(first, first + count)
    variables = [Variables("se2", keys, None if random_.random() < 0.5 else np.zeros((count, 3)))]
    if have == 0:
        variables.append(Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True))
    measured = np.array([[random_.gauss(1, 0.1), random_.gauss(0, 0.1), random_.gauss(0, 0.2)] for _ in keys])
    information = np.tile([100.0, 0, 0, 100, 0, 400], (count, 1))
    factors = [Factors("between_se2", np.stack([keys - 1, keys], axis=1), measured, information)]
    return Batch(tuple(variables), tuple(factors))


class Mutator:
    """Makes one message out of others.  The same seed makes the same messages."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.pool = golden()

    def any_message(self) -> bytes:
        """A golden message, mutated."""
        return self.mutated(self.random.choice(self.pool))

    def insert(self, sequence: int, batch: Batch) -> bytes:
        """An insert of `batch`, mutated in what it means or in its bytes; now and then not at all."""
        data = codec.encode_insert(Insert(sequence, batch))
        return data if self.random.random() < 0.15 else self.mutated(data)

    def mutated(self, data: bytes) -> bytes:
        """`data` with one to three things wrong."""
        for _ in range(self.random.choice((1, 1, 1, 2, 3))):
            data = self.random.choice(_MUTATIONS)(self, data)
        return data


def _flip_bits(mutator: Mutator, data: bytes) -> bytes:
    changed = bytearray(data)
    for _ in range(mutator.random.choice((1, 2, 8))):
        if changed:
            changed[mutator.random.randrange(len(changed))] ^= 1 << mutator.random.randrange(8)
    return bytes(changed)


def _cut(mutator: Mutator, data: bytes) -> bytes:
    return data[: mutator.random.randrange(len(data) + 1)]


def _insert_bytes(mutator: Mutator, data: bytes) -> bytes:
    at = mutator.random.randrange(len(data) + 1)
    return data[:at] + mutator.random.randbytes(mutator.random.choice((1, 2, 8, 64))) + data[at:]


def _splice(mutator: Mutator, data: bytes) -> bytes:
    other = mutator.random.choice(mutator.pool)
    return data[: mutator.random.randrange(len(data) + 1)] + other[mutator.random.randrange(len(other) + 1) :]


def _claim_a_length(mutator: Mutator, data: bytes) -> bytes:
    """A MessagePack head that promises far more than there is."""
    head = mutator.random.choice((b"\xc6", b"\xdb", b"\xdd", b"\xdf", b"\xc9"))
    at = mutator.random.randrange(len(data) + 1)
    return data[:at] + head + struct.pack(">I", mutator.random.choice((2**32 - 1, 2**31, 10**6, 300))) + data[at:]


def _nest(mutator: Mutator, data: bytes) -> bytes:
    at = mutator.random.randrange(len(data) + 1)
    level = mutator.random.choice((b"\x91", b"\x81\xa1a"))
    return data[:at] + level * mutator.random.choice((10, 600, 5000)) + data[at:]


def _meaning(change: Callable[[random.Random, list[tuple[Any, Any]]], None]) -> Callable[[Mutator, bytes], bytes]:
    """A mutation of the content, where `data` still has one."""

    def mutate(mutator: Mutator, data: bytes) -> bytes:
        try:
            content = msgpack.unpackb(data, strict_map_key=False)
            places = list(_places(content))
            if places:
                change(mutator.random, places)
            return msgpack.packb(content)
        except Exception:  # it is no message any more
            return _flip_bits(mutator, data)

    return mutate


def _places(content: Any) -> Iterator[tuple[Any, Any]]:
    """(container, key) of everything in it."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in list(items):
        yield content, key
        yield from _places(value)


def _replace(random_: random.Random, places: list[tuple[Any, Any]]) -> None:
    container, key = random_.choice(places)
    container[key] = random_.choice((*_THINGS, *_INTEGERS, *_NUMBERS))


def _remove(random_: random.Random, places: list[tuple[Any, Any]]) -> None:
    container, key = random_.choice(places)
    del container[key]


def _rename(random_: random.Random, places: list[tuple[Any, Any]]) -> None:
    container, key = random_.choice(places)
    if isinstance(container, dict):
        container[random_.choice(("keys", "kind", "values", "more", 7, b"keys", ""))] = container.pop(key)


def _swap(random_: random.Random, places: list[tuple[Any, Any]]) -> None:
    (a, i), (b, j) = random_.choice(places), random_.choice(places)
    a[i], b[j] = b[j], a[i]


def _other_kind(random_: random.Random, places: list[tuple[Any, Any]]) -> None:
    kinds = [(c, k) for c, k in places if k == "kind"]
    if kinds:
        container, key = random_.choice(kinds)
        container[key] = random_.choice((*FACTOR_KINDS, *VARIABLE_KINDS, "gps", ""))


def _columns(random_: random.Random, places: list[tuple[Any, Any]]) -> None:
    """Another number in a column, or a column of another length."""
    columns = [(c, k) for c, k in places if isinstance(c[k], bytes) and c[k]]
    if not columns:
        return
    container, key = random_.choice(columns)
    data = container[key]
    number = (
        struct.pack("<q", random_.choice(_INTEGERS[:7] + _INTEGERS[9:]))
        if key == "keys"
        else struct.pack("<d", random_.choice(_NUMBERS))
    )
    at = 8 * random_.randrange(max(len(data) // 8, 1))
    before, behind = data[:at], data[at + 8 :]
    changed = before + number + behind
    container[key] = random_.choice((changed, changed, data[:-8], data + number, data * 2, data[:-1], before + behind))


_MUTATIONS: tuple[Callable[[Mutator, bytes], bytes], ...] = (
    _flip_bits, _cut, _insert_bytes, _splice, _claim_a_length, _nest,
    *(_meaning(change) for change in (_replace, _remove, _rename, _swap, _other_kind, _columns, _columns, _columns)),
)  # fmt: skip
