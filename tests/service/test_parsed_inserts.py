"""The compiled reader of inserts against the codec: the same content, and nothing that it refuses."""

from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from factorbus.proto import codec
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES, VARIABLE_KINDS
from factorbus.proto.limits import REQUEST_LIMITS, MessageLimits
from factorbus.proto.messages import Batch, Factors, Insert, Variables
from factorbus.proto.problems import Problem, TooLarge
from factorbus.service.core.events import Arrived, ParsedInsert
from factorbus.service.kernels.wire_tokens import LONGEST
from factorbus.service.solving.arrival import message_digest, read_insert, try_parse
from factorbus.solver.graph.columns import ints_at
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE, LOSS_OF_CODE
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.graph import group_table as gt

VECTORS = Path(__file__).parents[2] / "proto" / "vectors"
MANY = settings(max_examples=400, deadline=None)
seeds = st.integers(0, 2**32 - 1)
# Either side of every change of form.
integers = st.sampled_from([0, 1, 127, 128, 255, 256, 65_535, 65_536, 2**32 - 1, 2**32, 2**62, 2**63 - 1])


def content_of(parsed: ParsedInsert) -> tuple[list[Any], list[Any]]:
    """Kinds and columns, bit for bit, at the places that were found."""

    def column(row: np.ndarray, which: int, numbers: int) -> bytes | None:
        start, count = int(row[which]), int(row[gt.G_COUNT]) * numbers
        return None if start == gt.NOWHERE else ints_at(parsed.message, start, count).tobytes()

    variables, factors = [], []
    for row in parsed.groups:
        if row[gt.G_KIND] == gt.END:
            break
        if row[gt.G_FACTORS]:
            kind, loss = FACTOR_KIND_OF_CODE[int(row[gt.G_KIND])], LOSS_OF_CODE.get(int(row[gt.G_LOSS]), "")
            sizes = {gt.G_KEYS: len(kind.connects), gt.G_NUMBERS: kind.size, gt.G_INFORMATION: kind.triangle}
            factors.append(
                (kind.name, *(column(row, *each) for each in sizes.items()), loss, column(row, gt.G_SCALE, 1))
            )
        else:
            kind = VARIABLE_KIND_OF_CODE[int(row[gt.G_KIND])]
            keys, values = column(row, gt.G_KEYS, 1), column(row, gt.G_NUMBERS, kind.size)
            variables.append((kind.name, keys, values, bool(row[gt.G_FIXED]), column(row, gt.G_STAMPS, 1)))
    return variables, factors


def bits(column: np.ndarray | None) -> bytes | None:
    return None if column is None else column.tobytes()


def content(batch: Batch) -> tuple[list[Any], list[Any]]:
    """The same of a batch."""
    variables = [(g.kind, g.keys.tobytes(), bits(g.values), g.fixed, bits(g.stamps)) for g in batch.variables]
    factors = [
        (g.kind, *(column.tobytes() for column in (g.keys, g.measured, g.information)), g.loss, bits(g.scale))
        for g in batch.factors
    ]
    return variables, factors


def check_agrees(message: bytes) -> bool:
    """Whether it was read where it lies; then the codec accepts it, with the same content."""
    parsed = try_parse(message, REQUEST_LIMITS)
    if parsed is None:
        return False
    insert = codec.decode_insert(message)
    assert parsed[:2] == (insert.sequence, insert.epoch)
    assert parsed[2] == message_digest(message)
    content_there = parsed[3]
    assert (content_there.settle, content_there.convert_below) == (insert.settle, insert.convert_below)
    assert (content_there.variables, content_there.factors) == (insert.batch.variable_count, insert.batch.factor_count)
    assert not insert.changes
    assert content_of(content_there) == content(insert.batch)
    return True


def random_batch(rng: np.random.Generator) -> Batch:
    """Groups of any kinds and sizes, with any bits in their columns."""

    def numbers(*shape: int) -> np.ndarray:
        return rng.integers(-(2**63), 2**63, shape).view(np.float64)

    variables, factors = [], []
    for kind in rng.choice(list(VARIABLE_KINDS), rng.integers(0, 5)).tolist():
        n = int(rng.integers(0, 6))
        values = numbers(n, VARIABLE_KINDS[kind].size) if rng.random() < 0.7 else None
        stamps = rng.integers(-(2**63), 2**63, n) if rng.random() < 0.5 else None
        variables.append(Variables(kind, rng.integers(-(2**63), 2**63, n), values, bool(rng.random() < 0.3), stamps))
    for name in rng.choice(list(FACTOR_KINDS), rng.integers(0, 5)).tolist():
        kind, n = FACTOR_KINDS[name], int(rng.integers(0, 20))
        ends = rng.integers(-(2**63), 2**63, (n, len(kind.connects)))
        loss = str(rng.choice(["", *LOSSES]))
        factors.append(
            Factors(
                name, ends, numbers(n, kind.size), numbers(n, kind.information_size), loss, numbers(n) if loss else None
            )
        )
    return Batch(tuple(variables), tuple(factors))


@MANY
@given(seeds, integers, integers, st.booleans(), st.floats(0.0, allow_nan=False, allow_infinity=False))
def test_every_insert_of_our_encoder_that_only_adds_is_read_where_it_lies(
    seed: int, sequence: int, epoch: int, settle: bool, below: float
) -> None:
    batch = random_batch(np.random.default_rng(seed))
    assert check_agrees(codec.encode_insert(Insert(max(sequence, 1), batch, settle, epoch, below)))


@pytest.mark.parametrize("groups", [15, 16, 30, 31, 200, 256])
def test_an_insert_may_have_as_many_groups_as_a_decoder_takes(groups: int) -> None:
    variables = tuple(Variables("point2", np.arange(n, n + 1)) for n in range(groups))
    factors = tuple(Factors("prior_point2", np.array([[n]]), np.ones((1, 2)), np.ones((1, 3))) for n in range(groups))
    assert check_agrees(codec.encode_insert(Insert(1, Batch(variables, factors))))


@pytest.mark.parametrize("groups", [257, 300])
def test_more_groups_are_left_to_the_codec(groups: int) -> None:
    variables = tuple(Variables("point2", np.arange(n, n + 1)) for n in range(groups))
    message = codec.encode_insert(Insert(1, Batch(variables)))
    assert not check_agrees(message)
    with pytest.raises(TooLarge):
        codec.decode_insert(message)


def test_an_insert_may_be_of_any_size() -> None:
    rng = np.random.default_rng(3)
    ends, numbers = rng.integers(0, 99, (50_000, 2)), rng.normal(size=(50_000, 9))
    factors = Factors("between_se2", ends, numbers[:, :3], numbers[:, 3:])
    assert check_agrees(codec.encode_insert(Insert(1, Batch((), (factors,)))))


# ---- what is not as usual --------------------------------------------------------------------------------------


def shuffled(content: dict[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    return {name: content[name] for name in rng.permutation(list(content)).tolist()}


@MANY
@given(seeds)
def test_fields_may_come_in_any_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    insert = msgpack.unpackb(codec.encode_insert(Insert(3, random_batch(rng), bool(seed % 2), 4)))
    for groups in ("variables", "factors"):
        insert[groups] = [shuffled(group, rng) for group in insert[groups]]
    assert check_agrees(msgpack.packb(shuffled(insert, rng)))


OTHERS: list[Any] = [
    0, 1, -1, 2**63, 2**64 - 1, 1.5, -1.5, np.nan, np.inf, True, None, "se2", "keys", "huber", "", "x" * 40, b"",
    b"12345678", bytes(24), [], {},
]  # fmt: skip
FIELDS = [
    "sequence", "values", "measured", "fixed", "settle", "stamps", "loss", "scale", "ids", "convert_below", "changes",
    "colour",
]  # fmt: skip


@MANY
@given(seeds)
def test_what_is_wrong_is_left_to_the_codec(seed: int) -> None:
    """Fields exchanged, missing, doubled or unknown; values of other types and lengths; at any level."""
    rng = np.random.default_rng(seed)
    insert = msgpack.unpackb(codec.encode_insert(Insert(3, random_batch(rng), False, 4)))
    for _ in range(rng.integers(1, 4)):
        level = rng.choice(np.array([insert, *insert.get("variables", ()), *insert.get("factors", ())], object))
        if not isinstance(level, dict) or not level:
            continue
        name = rng.choice(list(level))
        other = OTHERS[rng.integers(len(OTHERS))]
        match rng.integers(4):
            case 0:
                del level[name]
            case 1:
                level[str(rng.choice(FIELDS))] = other
            case 2 if isinstance(level[name], bytes):
                level[name] = level[name][: rng.integers(0, len(level[name]) + 1)] + bytes(rng.integers(0, 17))
            case _ if name not in ("variables", "factors"):
                level[name] = other
        if not all(isinstance(insert.get(groups, []), list) for groups in ("variables", "factors")):
            break
    check_agrees(msgpack.packb(insert, use_single_float=bool(seed % 2)))


@MANY
@given(seeds)
def test_bytes_that_were_damaged_are_never_taken_for_something_else(seed: int) -> None:
    rng = np.random.default_rng(seed)
    message = bytearray(codec.encode_insert(Insert(3, random_batch(rng), True, 2**40)))
    match rng.integers(4):
        case 0:
            del message[rng.integers(len(message)) :]
        case 1:
            message += bytes(rng.integers(1, 9))
        case _:
            for place in rng.integers(0, len(message), rng.integers(1, 4)):
                message[place] = rng.integers(256)
    check_agrees(bytes(message))


@settings(max_examples=1000, deadline=None)
@given(st.binary(max_size=64))
def test_any_bytes_at_all(message: bytes) -> None:
    check_agrees(message)


PRIOR = {"kind": "prior_point2", "keys": bytes(8), "measured": bytes(16), "information": bytes(24)}
UNUSUAL = {
    "no sequence": msgpack.packb({"epoch": 1}),
    "sequence 0": msgpack.packb({"sequence": 0}),
    "sequence beyond": msgpack.packb({"sequence": 2**63}),
    "negative epoch": msgpack.packb({"sequence": 1, "epoch": -1}),
    "a field twice": b"\x82\xa8sequence\x01\xa8sequence\x02",
    "kind twice": b"\x82\xa8sequence\x01\xa9variables\x91\x83\xa4kind\xa3se2\xa4keys\xc4\x00\xa4kind\xa6point2",
    "an unknown field": msgpack.packb({"sequence": 1, "colour": "red"}),
    "an unknown kind": msgpack.packb({"sequence": 1, "variables": [{"kind": "se4", "keys": b""}]}),
    "a factor's kind for variables": msgpack.packb({"sequence": 1, "variables": [{"kind": "prior_se2", "keys": b""}]}),
    "factors without keys": msgpack.packb(
        {"sequence": 1, "factors": [{"kind": "prior_se2", "measured": b"", "information": b""}]}
    ),
    "factors without information": msgpack.packb(
        {"sequence": 1, "factors": [{"kind": "prior_se2", "keys": b"", "measured": b""}]}
    ),
    "nothing": b"",
    "something behind": msgpack.packb({"sequence": 1}) + b"\xc0",
    "stamps of factors": msgpack.packb(
        {
            "sequence": 1,
            "factors": [{"kind": "prior_se2", "keys": b"", "measured": b"", "information": b"", "stamps": b""}],
        }
    ),
    "stamps that are too few": msgpack.packb(
        {"sequence": 1, "variables": [{"kind": "se2", "keys": bytes(16), "stamps": bytes(8)}]}
    ),
    "stamps twice": b"\x82\xa8sequence\x01\xa9variables\x91\x84\xa4kind\xa3se2\xa4keys\xc4\x00" + 2 * b"\xa6stamps\xc0",
    "a signed integer below zero": b"\x81\xa8sequence\xd0\xff",
    "a scale without a loss": msgpack.packb({"sequence": 1, "factors": [PRIOR | {"scale": bytes(8)}]}),
    "a loss without a scale": msgpack.packb({"sequence": 1, "factors": [PRIOR | {"loss": "huber"}]}),
    "an unknown loss": msgpack.packb({"sequence": 1, "factors": [PRIOR | {"loss": "welsch", "scale": bytes(8)}]}),
    "ids that are nil": msgpack.packb({"sequence": 1, "factors": [PRIOR | {"ids": None}]}),
    "convert_below infinite": msgpack.packb({"sequence": 1, "convert_below": np.inf}),
    "convert_below negative": msgpack.packb({"sequence": 1, "convert_below": -1}),
    "changes, though none": msgpack.packb({"sequence": 1, "changes": []}),
    "settle that is nil": msgpack.packb({"sequence": 1, "settle": None}),
}


OTHER_FORMS = {
    "a long map": b"\xde\x00\x01\xa8sequence\x01",
    "a long array": b"\x82\xa8sequence\x01\xa9variables\xdc\x00\x00",
    "a long string": b"\x81\xd9\x08sequence\x01",
    "a signed integer": b"\x81\xa8sequence\xd0\x01",
    "a long string of a kind": b"\x82\xa8sequence\x01\xa9variables\x91\x82\xa4kind\xda\x00\x03se2\xa4keys\xc4\x00",
    "no groups, by nil": msgpack.packb({"sequence": 1, "variables": None, "factors": None, "epoch": None}),
    "convert_below an integer": msgpack.packb({"sequence": 1, "convert_below": 3}),
    "convert_below a short float": msgpack.packb({"sequence": 1, "convert_below": 0.25}, use_single_float=True),
    "convert_below nil": msgpack.packb({"sequence": 1, "convert_below": None}),
    "a loss that is nil": msgpack.packb({"sequence": 1, "factors": [PRIOR | {"loss": None, "scale": None}]}),
    "ids": msgpack.packb({"sequence": 1, "factors": [PRIOR | {"ids": bytes(8)}]}),
    "values and stamps that are nil": msgpack.packb(
        {"sequence": 1, "variables": [{"kind": "se2", "keys": b"", "values": None, "stamps": None}]}
    ),
}


@pytest.mark.parametrize("name", OTHER_FORMS)
def test_every_form_of_what_is_right_is_read(name: str) -> None:
    assert check_agrees(OTHER_FORMS[name])


@pytest.mark.parametrize("name", UNUSUAL)
def test_left_to_the_codec(name: str) -> None:
    assert try_parse(UNUSUAL[name], REQUEST_LIMITS) is None


def test_the_limits_of_a_service_hold_for_both() -> None:
    message = codec.encode_insert(Insert(1, Batch((Variables("se2", np.arange(9), np.zeros((9, 3))),))))
    assert try_parse(message, REQUEST_LIMITS)
    for limits in (MessageLimits(len(message) - 1, 100, 100), MessageLimits(1 << 20, 8, 100)):
        assert try_parse(message, limits) is None
        with pytest.raises(TooLarge):
            codec.decode_insert(message, limits)


def test_an_arrival_is_the_same_either_way(monkeypatch: pytest.MonkeyPatch) -> None:
    message = codec.encode_insert(Insert(7, Batch(), True, 9))
    quick = read_insert("asker", "robot", message, REQUEST_LIMITS, 1.5)
    monkeypatch.setattr("factorbus.service.solving.arrival.try_parse", lambda *_: None)
    usual = read_insert("asker", "robot", message, REQUEST_LIMITS, 1.5)
    assert isinstance(quick, Arrived)
    assert isinstance(usual, Arrived)
    assert isinstance(quick.content, ParsedInsert)
    assert isinstance(usual.content, Insert)
    assert quick._replace(content=usual.content) == usual


@MANY
@given(st.binary(max_size=40), seeds)
def test_a_digest_tells_messages_apart(message: bytes, seed: int) -> None:
    others = {message + b"\0", message[:-1], b"\0" + message, message[::-1]} - {message}
    for k in range(8 * len(message)):
        changed = bytearray(message)
        changed[k // 8] ^= 1 << k % 8
        others.add(bytes(changed))
    assert len({message_digest(other) for other in (message, *others)}) == len(others) + 1
    assert 0 <= message_digest(message) < 2**63


def test_the_digest_of_a_message_never_changes() -> None:
    wanted = [7775671951334427883, 6423431365456653165, 9160638965743508112]
    assert [message_digest(message) for message in (b"", b"factorbus", bytes(range(256)))] == wanted


@pytest.mark.parametrize("name", ["insert_observations", "insert_points", "insert_losses"])
def test_observations_losses_and_conversion_are_read_where_they_lie(name: str) -> None:
    path = VECTORS / f"{name}.msgpack"
    assert path.exists()
    assert check_agrees(path.read_bytes())


def test_the_names_of_all_kinds_can_be_read() -> None:
    """A reader gives up at longer ones."""
    assert max(len(name.encode()) for name in (*VARIABLE_KINDS, *FACTOR_KINDS, *LOSSES)) <= LONGEST


def test_a_problem_inside_still_uses_up_its_number() -> None:
    message = msgpack.packb({"sequence": 4, "epoch": 2, "factors": [{"kind": "no_such", "keys": b""}]})
    arrived = read_insert("asker", "robot", message, REQUEST_LIMITS, 0.0)
    assert isinstance(arrived, Arrived)
    assert (arrived.sequence, arrived.epoch) == (4, 2)
    assert isinstance(arrived.content, Problem)
