"""Bytes of the question ask/repair and of its answer, both ways.  Readers raise BadMessage, TooLarge."""

from typing import Any

import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import F64, I64
from factorbus.proto.asking import AskRepair, Repaired
from factorbus.proto.asking_codec import probability
from factorbus.proto.codec import encode_map
from factorbus.proto.columns import read_values, variables_to_maps
from factorbus.proto.fields import F8, I8, Map
from factorbus.proto.limits import ANSWER_LIMITS, REQUEST_LIMITS, MessageLimits
from factorbus.proto.problems import BadMessage
from factorbus.wording import counted


def encode_ask_repair(ask: AskRepair) -> bytes:
    """The bytes of the question."""
    content: dict[str, Any] = {"probability": float(ask.probability)}
    if ask.factors is not None:
        content["factors"] = np.asarray(ask.factors, I8).tobytes()
    if ask.values:
        content["values"] = True
    return encode_map(content)


def decode_ask_repair(data: bytes, limits: MessageLimits = REQUEST_LIMITS) -> AskRepair:
    """The question that `data` is; no bytes at all: everything as by default."""
    content = fields.read_map("question", data, limits) if data else {}
    factors = None if content.get("factors") is None else _integers("question", content, "factors")
    return AskRepair(factors, probability(content, 0.99), fields.flag("question", content, "values"))


def encode_repaired(message: Repaired) -> bytes:
    """The bytes of the answer to ask/repair."""
    content: dict[str, Any] = {
        "epoch": message.epoch,
        "revision": message.revision,
        "factors": np.asarray(message.factors, I8).tobytes(),
        "distance": np.asarray(message.distance, F8).tobytes(),
        "suspects": message.suspects,
        "before": message.before,
        "after": message.after,
        "chi2_left": message.chi2_left,
        "seconds": message.seconds,
    }
    if message.variables:
        content["variables"] = variables_to_maps(message.variables)
    return encode_map(content)


def decode_repaired(data: bytes, limits: MessageLimits = ANSWER_LIMITS) -> Repaired:
    """The answer to ask/repair that `data` is."""
    content = fields.read_map("repaired", data, limits)
    factors = _integers("", content, "factors")
    distance: F64 = fields.rows(lambda: "repaired", content, "distance", factors.size, 1).reshape(-1)
    return Repaired(
        fields.integer("", content, "epoch"),
        fields.integer("", content, "revision"),
        factors,
        distance,
        fields.integer("", content, "suspects"),
        fields.number("", content, "before"),
        fields.number("", content, "after"),
        fields.number("", content, "chi2_left"),
        fields.number("", content, "seconds"),
        read_values(content),
    )


def _integers(where: str, content: Map, name: str) -> I64:
    value = fields.binary(where, content, name)
    if len(value) % 8:
        raise BadMessage(name, counted(len(value), "byte"), "a multiple of 8")
    return np.ndarray((len(value) // 8,), I8, value)
