"""Bytes of the questions in `asking` and of their answers, both ways.  Every reader raises BadMessage, TooLarge."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import F64, I64
from factorbus.proto.asking import (
    BLOCKS,
    AskAssociate,
    AskCovariance,
    AskGain,
    AskGate,
    AskWhy,
    Associated,
    CovarianceGroup,
    Covariances,
    Gained,
    Gated,
    Why,
)
from factorbus.proto.codec import encode_map
from factorbus.proto.columns import factors_to_maps, read_batch
from factorbus.proto.fields import F8, I8, Map
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.limits import ANSWER_LIMITS, REQUEST_LIMITS, MessageLimits
from factorbus.proto.messages import Factors
from factorbus.proto.problems import BadMessage, UnknownKind
from factorbus.wording import counted

# Where quantiles of χ² are numbers that can be computed with.
_SURE = (1e-12, 1.0 - 1e-12)
_LANDMARK_KINDS = ("landmark_se2", "landmark_se3", "bearing_range_se2")  # of a point, from a pose


def encode_ask_covariance(ask: AskCovariance) -> bytes:
    """The bytes of the question."""
    content: dict[str, Any] = {"blocks": ask.blocks}
    for name, column in (("keys", ask.keys), ("others", ask.others)):
        if column is not None:
            content[name] = _i8(column)
    return encode_map(content)


def decode_ask_covariance(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskCovariance:
    """The question; no bytes at all: the whole diagonal."""
    content = fields.read_map("question", data, limits) if data else {}
    blocks = fields.choice_of("question", content, "blocks", BLOCKS, "diagonal")
    keys = _keys(content, "keys", needed=blocks in ("joint", "cross", "relative"))
    others = _keys(content, "others", needed=blocks == "cross")
    if blocks == "relative" and keys is not None:
        if keys.size % 2:
            raise BadMessage("question.keys", counted(keys.size, "key"), "pairs")
        keys = keys.reshape(-1, 2)
    return AskCovariance(blocks, keys, others)


def encode_covariances(message: Covariances) -> bytes:
    """The bytes of the answer to ask/covariance."""
    content: dict[str, Any] = {"epoch": message.epoch, "revision": message.revision, "blocks": message.blocks}
    if message.blocks in ("joint", "cross"):
        names = ("keys", "dims", "others", "other_dims")
        columns = {name: getattr(message, name) for name in names}
        content |= {name: _i8(column) for name, column in columns.items() if column is not None}
        return encode_map(content | {"covariance": _f8(message.covariance)})
    groups = []
    for group in message.groups:
        one = {"kind": group.kind, "keys": _i8(group.keys), "covariance": _f8(group.covariance)}
        groups.append(one if group.values is None else one | {"values": _f8(group.values)})
    return encode_map(content | {"groups": groups})


def decode_covariances(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Covariances:
    """The answer to ask/covariance that `data` is."""
    content = fields.read_map("covariances", data, limits)
    epoch, revision = (fields.integer("", content, name) for name in ("epoch", "revision"))
    blocks = fields.text("", content, "blocks")
    if blocks not in ("joint", "cross"):
        groups = tuple(_read_group(i, each, blocks) for i, each in enumerate(fields.maps("", content, "groups")))
        return Covariances(epoch, revision, blocks, groups)
    keys, dims, others, other_dims = (
        _keys(content, name, needed=blocks == "cross" or not name.startswith("other"))
        for name in ("keys", "dims", "others", "other_dims")
    )
    rows = int(dims.sum()) if dims is not None else 0
    columns = rows if other_dims is None else int(other_dims.sum())
    covariance = _read_f8("", content, "covariance", rows * columns).reshape(rows, columns)
    return Covariances(epoch, revision, blocks, (), keys, dims, others, other_dims, covariance)


def encode_ask_gate(ask: AskGate) -> bytes:
    """The bytes of the question."""
    return encode_map({"factors": factors_to_maps(ask.factors), "probability": float(ask.probability)})


def decode_ask_gate(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskGate:
    """The question that `data` is."""
    content = fields.read_map("question", data, limits)
    return AskGate(_factors(content, limits), probability(content, 0.95))


def encode_gated(message: Gated) -> bytes:
    """The bytes of the answer to ask/gate."""
    return encode_map(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "distance": _f8(message.distance),
            "dims": _i8(message.dims),
            "threshold": _f8(message.threshold),
            "plausible": _flags(message.plausible),
        }
    )


def decode_gated(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Gated:
    """The answer to ask/gate that `data` is."""
    content = fields.read_map("gated", data, limits)
    dims = _keys(content, "dims", needed=True)
    count = len(dims) if dims is not None else 0
    distance, threshold = (_read_f8("", content, name, count) for name in ("distance", "threshold"))
    return Gated(*_when(content), distance, np.asarray(dims), threshold, _read_flags(content, "plausible", count))


def encode_ask_gain(ask: AskGain) -> bytes:
    """The bytes of the question."""
    return encode_map({"factors": factors_to_maps(ask.factors)})


def decode_ask_gain(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskGain:
    """The question that `data` is."""
    return AskGain(_factors(fields.read_map("question", data, limits), limits))


def encode_gained(message: Gained) -> bytes:
    """The bytes of the answer to ask/gain."""
    return encode_map({"epoch": message.epoch, "revision": message.revision, "gain": _f8(message.gain)})


def decode_gained(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Gained:
    """The answer to ask/gain that `data` is."""
    content = fields.read_map("gained", data, limits)
    return Gained(*_when(content), _read_f8("", content, "gain", None))


def encode_ask_associate(ask: AskAssociate) -> bytes:
    """The bytes of the question."""
    content = {
        "pose": int(ask.pose),
        "kind": ask.kind,
        "measured": _f8(ask.measured),
        "information": _f8(ask.information),
        "probability": float(ask.probability),
    }
    return encode_map(content if ask.landmarks is None else content | {"landmarks": _i8(ask.landmarks)})


def decode_ask_associate(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskAssociate:
    """The question that `data` is."""
    content = fields.read_map("question", data, limits)
    kind = fields.text("", content, "kind")
    if kind not in _LANDMARK_KINDS:
        raise UnknownKind("question.kind", kind, _LANDMARK_KINDS)
    size = FACTOR_KINDS[kind].size
    measured = _read_f8("question", content, "measured", None)
    if measured.size % size:
        raise BadMessage("question.measured", counted(measured.size, "number"), f"a multiple of {size}")
    count = measured.size // size
    information = _read_f8("question", content, "information", count * FACTOR_KINDS[kind].information_size)
    return AskAssociate(
        _key(content, "pose"),
        kind,
        measured.reshape(count, size),
        information.reshape(count, -1) if count else information.reshape(0, FACTOR_KINDS[kind].information_size),
        _keys(content, "landmarks", needed=False),
        probability(content, 0.95),
    )


def encode_associated(message: Associated) -> bytes:
    """The bytes of the answer to ask/associate."""
    return encode_map(
        {
            "epoch": message.epoch,
            "revision": message.revision,
            "landmarks": _i8(message.landmarks),
            "matched": _flags(message.matched),
            "distance": message.distance,
            "dims": message.dims,
            "threshold": message.threshold,
            "complete": message.complete,
            "observations": _i8(message.observations),
            "candidates": _i8(message.candidates),
            "distances": _f8(message.distances),
        }
    )


def decode_associated(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Associated:
    """The answer to ask/associate that `data` is."""
    content = fields.read_map("associated", data, limits)
    landmarks, observations, candidates = (
        np.asarray(_keys(content, name, needed=True)) for name in ("landmarks", "observations", "candidates")
    )
    return Associated(
        *_when(content),
        landmarks,
        _read_flags(content, "matched", len(landmarks)),
        fields.number("", content, "distance"),
        fields.integer("", content, "dims"),
        fields.number("", content, "threshold"),
        fields.flag("", content, "complete"),
        observations,
        candidates,
        _read_f8("", content, "distances", len(observations)),
    )


def encode_ask_why(ask: AskWhy) -> bytes:
    """The bytes of the question."""
    named = {"key": ask.key, "factor": ask.factor}
    return encode_map({name: int(value) for name, value in named.items() if value is not None})


def decode_ask_why(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskWhy:
    """The question that `data` is."""
    content = fields.read_map("question", data, limits)
    if ("key" in content) == ("factor" in content):
        raise BadMessage("question", "has both or neither of key and factor", "one of them")
    if "key" in content:
        return AskWhy(key=_key(content, "key"))
    return AskWhy(factor=fields.integer("", content, "factor"))


def encode_why(message: Why) -> bytes:
    """The bytes of the answer to ask/why."""
    content: dict[str, Any] = {"epoch": message.epoch, "revision": message.revision, "step": dict(message.step)}
    if message.variable:
        content["variable"] = dict(message.variable)
    if message.factor:
        content["factor"] = dict(message.factor)
    return encode_map(content)


def decode_why(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Why:
    """The answer to ask/why that `data` is."""
    content = fields.read_map("why", data, limits)
    variable, factor, step = (fields.mapping("", content, name) for name in ("variable", "factor", "step"))
    return Why(*_when(content), variable, factor, step)


def _when(content: Map) -> tuple[int, int]:
    return fields.integer("", content, "epoch"), fields.integer("", content, "revision")


def _factors(content: Map, limits: MessageLimits) -> tuple[Factors, ...]:
    return read_batch({"factors": content.get("factors")}, limits).factors


def probability(content: Map, default: float) -> float:
    """The parameter of that name.  Raises BadMessage, BadOption."""
    return fields.parameter("question", content, "probability", _SURE, "from 1e-12 to 1 - 1e-12", default)


def _key(content: Map, name: str) -> int:
    value = content.get(name)
    if type(value) is not int or not -(2**63) <= value <= fields.MAX_INTEGER:
        raise BadMessage(f"question.{name}", f"is {value!r:.40}", "a variable's key, an integer of 64 bits")
    return value


def _keys(content: Map, name: str, needed: bool) -> I64 | None:
    value = content.get(name)
    if value is None and not needed:
        return None
    if type(value) is not bytes or len(value) % 8:
        seen = "missing" if value is None else counted(len(value), "byte") if type(value) is bytes else "not a bin"
        raise BadMessage(name, seen, "a bin of <i8")
    return np.frombuffer(value, I8)


def _read_f8(where: str, content: Map, name: str, count: int | None) -> F64:
    value = content.get(name)
    place = f"{where}.{name}" if where else name
    if type(value) is not bytes or len(value) % 8:
        raise BadMessage(place, "missing or not a bin of <f8", "a bin of <f8")
    if count is not None and len(value) != 8 * count:
        raise BadMessage(place, counted(len(value), "byte"), f"{8 * count} ({count} float64)")
    return np.frombuffer(value, F8)


def _read_group(index: int, content: Mapping[str, Any], blocks: str) -> CovarianceGroup:
    place = f"groups[{index}]"
    keys = fields.keys(lambda: place, content, 2 if blocks == "relative" else 0)
    covariance = _read_f8(place, content, "covariance", None)
    dim = math.isqrt(covariance.size // len(keys)) if len(keys) else 0
    if covariance.size != len(keys) * dim * dim:
        raise BadMessage(f"{place}.covariance", counted(covariance.size, "number"), counted(len(keys), "square"))
    values = None
    if content.get("values") is not None:
        values = _read_f8(place, content, "values", None).reshape(len(keys), -1 if len(keys) else 0)
    kind = fields.text(place, content, "kind")
    return CovarianceGroup(kind, keys, covariance.reshape(len(keys), dim, dim), values)


def _i8(column: Any) -> bytes:
    return np.ascontiguousarray(column, I8).tobytes()


def _f8(column: Any) -> bytes:
    return np.ascontiguousarray(column, F8).tobytes()


def _flags(column: Any) -> bytes:
    return np.asarray(column, np.uint8).tobytes()


def _read_flags(content: Map, name: str, count: int) -> Any:
    value = fields.binary("", content, name)
    if len(value) != count:
        raise BadMessage(name, counted(len(value), "byte"), f"{count}")
    return np.frombuffer(value, np.uint8).astype(bool)
