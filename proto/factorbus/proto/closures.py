"""Loop closures that a map tests: what it says of them, and how its verdicts are written down.  Both ways, as bytes.

A map with the policy `test` or `robust` has a state for each closure.  Its verdicts are entries of its journal, those
of the client `own_clients.JUDGE`: a name that no client on the bus can have.  Readers raise BadMessage, TooLarge.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import F64, I64
from factorbus.proto.codec import decode_map, encode_map
from factorbus.proto.fields import F8, I8, Map
from factorbus.proto.limits import ANSWER_LIMITS, REQUEST_LIMITS, MessageLimits
from factorbus.proto.problems import BadMessage
from factorbus.wording import counted

CLOSURE_POLICIES = ("trust", "test", "robust")
CLOSURE_STATES = ("accepted", "suspect", "rejected", "restored")
# Why a state is what it is.
CLOSURE_REASONS = (
    "new", "passed", "agrees", "unsure", "improbable", "rival", "contradicted", "failed", "user",
    "fits", "graduating", "graduated", "light", "outweighed",
)  # fmt: skip
# What the event `closures` says of one that the map has no more, and why: a change named it, or a pose of it went.
GONE, REMOVED, POSE_GONE = "gone", "removed", "pose_gone"


@dataclass(frozen=True, slots=True)
class ClosureEntry:
    """An entry of a journal: what some closures are from now on.  factors (n,): ids; a state and a reason of each.

    distance (n,): d²; chance (n,): the odds that it is false, with the policy "robust" its weight; tried (n,): the
    newest rival at the last trial, −1: none.  ahead: they are believed, and went in with the step of the insert before.
    scale (n,): with the policy "robust", of the loss geman-mcclure that each has from now on; None: they keep theirs.
    """

    sequence: int
    factors: I64
    states: tuple[str, ...]
    reasons: tuple[str, ...]
    distance: F64
    chance: F64
    tried: I64
    ahead: bool = False
    scale: F64 | None = None


@dataclass(frozen=True, slots=True)
class AskSuspects:
    """every: of all closures, not of those alone that the estimate does not have."""

    every: bool = False


@dataclass(frozen=True, slots=True)
class Suspects:
    """The answer to ask/suspects: closures that the estimate does not have, or hardly, or all, in the order they came.

    policy: one of CLOSURE_POLICIES; with "trust" there are none.  counts: of all closures, by state.  factors (n,):
    ids; keys (n, 2): the poses they are between; kinds, states, reasons: of each.  distance (n,): d² and chance (n,):
    the odds that it is false, when it was last looked at, NaN before.  came, changed (n,): revisions, when
    it was inserted, and since when its state is this one.  weight (n,): with the policy "robust", by which its
    information counts at the estimate when it was last looked at, `chance` is 1 − weight; None with the others.
    """

    epoch: int
    revision: int
    policy: str
    counts: dict[str, int] = field(default_factory=dict)
    factors: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    keys: I64 = field(default_factory=lambda: np.empty((0, 2), np.int64))
    kinds: tuple[str, ...] = ()
    states: tuple[str, ...] = ()
    reasons: tuple[str, ...] = ()
    distance: F64 = field(default_factory=lambda: np.empty(0))
    chance: F64 = field(default_factory=lambda: np.empty(0))
    came: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    changed: I64 = field(default_factory=lambda: np.empty(0, np.int64))
    weight: F64 | None = None


def encode_closure_entry(message: ClosureEntry) -> bytes:
    """The bytes of an entry."""
    return encode_map(
        {
            "sequence": message.sequence,
            "factors": _bytes(message.factors, I8),
            "states": list(message.states),
            "reasons": list(message.reasons),
            "distance": _bytes(message.distance, F8),
            "chance": _bytes(message.chance, F8),
            "tried": _bytes(message.tried, I8),
            **({"ahead": True} if message.ahead else {}),
            **({} if message.scale is None else {"scale": _bytes(message.scale, F8)}),
        }
    )


def decode_closure_entry(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> ClosureEntry:
    """The entry that `data` is."""
    content = fields.read_map("closure entry", data, limits)
    factors = _integers(content, "factors")
    return ClosureEntry(
        fields.integer("", content, "sequence", least=1),
        factors,
        _texts(content, "states", factors.size, CLOSURE_STATES),
        _texts(content, "reasons", factors.size),
        _numbers(content, "distance", factors.size),
        _numbers(content, "chance", factors.size),
        _integers(content, "tried", factors.size),
        fields.flag("", content, "ahead"),
        _numbers(content, "scale", factors.size) if "scale" in content else None,
    )


def encode_ask_suspects(ask: AskSuspects) -> bytes:
    """The bytes of the question."""
    return encode_map({"all": True} if ask.every else {})


def decode_ask_suspects(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskSuspects:
    """The question that `data` is; no bytes at all: everything as by default."""
    return AskSuspects(fields.flag("question", decode_map(data, limits, what="question"), "all"))


def encode_suspects(message: Suspects) -> bytes:
    """The bytes of the answer to ask/suspects."""
    return encode_map(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "closures": message.policy,
            "counts": dict(message.counts),
            "factors": _bytes(message.factors, I8),
            "keys": _bytes(message.keys, I8),
            "kinds": list(message.kinds),
            "states": list(message.states),
            "reasons": list(message.reasons),
            "distance": _bytes(message.distance, F8),
            "chance": _bytes(message.chance, F8),
            "came": _bytes(message.came, I8),
            "changed": _bytes(message.changed, I8),
            **({} if message.weight is None else {"weight": _bytes(message.weight, F8)}),
        }
    )


def decode_suspects(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Suspects:
    """The answer that `data` is."""
    content = fields.read_map("suspects", data, limits)
    factors = _integers(content, "factors")
    counts = fields.mapping("", content, "counts")
    return Suspects(
        epoch=fields.integer("", content, "epoch"),
        revision=fields.integer("", content, "revision"),
        policy=fields.text("", content, "closures"),
        counts={str(state): fields.integer("counts", counts, state) for state in counts},
        factors=factors,
        keys=_integers(content, "keys", 2 * factors.size).reshape(-1, 2),
        kinds=_texts(content, "kinds", factors.size),
        states=_texts(content, "states", factors.size),
        reasons=_texts(content, "reasons", factors.size),
        distance=_numbers(content, "distance", factors.size),
        chance=_numbers(content, "chance", factors.size),
        came=_integers(content, "came", factors.size),
        changed=_integers(content, "changed", factors.size),
        weight=_numbers(content, "weight", factors.size) if "weight" in content else None,
    )


def _bytes(column: Any, dtype: np.dtype) -> bytes:
    return np.asarray(column, dtype).tobytes()


def _integers(content: Map, name: str, count: int | None = None) -> I64:
    value = fields.binary("", content, name)
    if len(value) % 8 or (count is not None and len(value) != 8 * count):
        raise BadMessage(name, counted(len(value), "byte"), "a multiple of 8" if count is None else f"{8 * count}")
    return np.ndarray((len(value) // 8,), I8, value)


def _numbers(content: Map, name: str, count: int) -> F64:
    return fields.rows(lambda: "", content, name, count, 1).reshape(-1)


def _texts(content: Map, name: str, count: int, known: tuple[str, ...] = ()) -> tuple[str, ...]:
    """An array of strings.  known: which there are; none: any."""
    value = content.get(name)
    if type(value) is not list or len(value) != count or any(type(each) is not str for each in value):
        raise BadMessage(name, "something else", f"an array of {counted(count, 'string')}")
    for each in value:
        if known and each not in known:
            raise BadMessage(name, f"has {each[:40]!r}", f"some of {', '.join(known)}")
    return tuple(value)
