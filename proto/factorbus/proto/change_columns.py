"""Changes of a map as maps of columns, both ways."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import I64
from factorbus.proto.fields import F8, I8, Map
from factorbus.proto.kinds import CHANGES, LOSSES, VARIABLE_KINDS
from factorbus.proto.messages import Change
from factorbus.proto.problems import BadLoss, BadMessage, UnknownKind
from factorbus.wording import counted


def changes_to_maps(changes: Sequence[Change]) -> list[dict[str, Any]]:
    """What the field `changes` of an insert holds."""
    return [_map(change) for change in changes]


def read_changes(message: Map) -> tuple[Change, ...]:
    """The changes in `message`.  Raises BadMessage; UnknownKind and BadLoss are such."""
    return tuple(_read(i, content) for i, content in enumerate(fields.maps("", message, "changes")))


def _map(change: Change) -> dict[str, Any]:
    of = CHANGES[change.change]
    content: dict[str, Any] = {"change": change.change}
    if of.names == "factors":
        content["factors"] = _bytes(change.factors, I8)
    else:
        content["keys"] = _bytes(change.keys, I8)
    if of.numbers == "scale" and change.loss:
        content |= {"loss": change.loss, "scale": _bytes(change.scale, F8)}
    elif of.numbers == "weight":
        content["weight"] = _bytes(change.weight, F8)
    elif of.numbers == "values":
        content |= {"kind": change.kind, "values": _bytes(change.values, F8)}
    if change.alone:
        content["alone"] = True
    if change.carry:
        content["carry"] = True
    return content


def _read(index: int, content: Map) -> Change:
    def place() -> str:
        return f"changes[{index}]"

    name = fields.text(place(), content, "change")
    of = CHANGES.get(name)
    if of is None:
        raise UnknownKind(f"{place()}.change", name, tuple(CHANGES))
    named = _column(place, content, of.names)
    if of.numbers == "values":
        kind = fields.text(place(), content, "kind")
        if kind not in VARIABLE_KINDS:
            raise UnknownKind(f"{place()}.kind", kind, tuple(VARIABLE_KINDS))
        rows = fields.rows(place, content, "values", named.size, VARIABLE_KINDS[kind].size)
        return Change(name, keys=named, kind=kind, values=rows, carry=fields.flag(place(), content, "carry"))
    if of.names == "keys":
        return Change(name, keys=named, alone=name == "remove_variables" and fields.flag(place(), content, "alone"))
    if of.numbers == "weight":
        return Change(name, named, weight=fields.rows(place, content, "weight", named.size, 1).reshape(-1))
    if not of.numbers or content.get("loss") is None:
        if of.numbers and content.get("scale") is not None:
            raise BadMessage(f"{place()}.scale", "a scale without a loss", f"loss: one of {', '.join(LOSSES)}")
        return Change(name, named)
    loss = fields.text(place(), content, "loss")
    if loss not in LOSSES:
        raise BadLoss(f"{place()}.loss", repr(loss[:64]), f"one of {', '.join(LOSSES)}, or no such field")
    return Change(name, named, loss=loss, scale=fields.rows(place, content, "scale", named.size, 1).reshape(-1))


def _column(place: Callable[[], str], content: Map, name: str) -> I64:
    """A column of int64 of any length."""
    value = fields.binary(place(), content, name)
    if len(value) % 8:
        raise BadMessage(f"{place()}.{name}", counted(len(value), "byte"), "a multiple of 8")
    return np.ndarray((len(value) // 8,), I8, value)


def _bytes(column: Any, dtype: np.dtype) -> bytes:
    return np.asarray(column, dtype).tobytes()
