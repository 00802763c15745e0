"""Groups of variables and factors as maps of columns, both ways.  Shapes come from the kind and the number of keys."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from factorbus.proto import fields
from factorbus.proto.arrays import I64
from factorbus.proto.fields import F8, I8, Map
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES, VARIABLE_KINDS
from factorbus.proto.limits import MessageLimits
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import BadLoss, BadMessage, BadStamp, TooLarge, UnknownKind
from factorbus.wording import counted


def variables_to_maps(groups: Sequence[Variables]) -> list[dict[str, Any]]:
    """What the field `variables` of a message holds."""
    return [_variables_map(group) for group in groups]


def factors_to_maps(groups: Sequence[Factors]) -> list[dict[str, Any]]:
    """What the field `factors` of a message holds."""
    return [_factors_map(group) for group in groups]


def read_batch(message: Map, limits: MessageLimits) -> Batch:
    """The batch in `message`; every kind has to be known.  Raises BadMessage, UnknownKind, TooLarge."""
    variables = [_read_variables(i, m, strict=True) for i, m in enumerate(fields.maps("", message, "variables"))]
    factors = [_read_factors(i, m) for i, m in enumerate(fields.maps("", message, "factors"))]
    _check_count("variables", variables, limits.max_variables)
    _check_count("factors", factors, limits.max_factors)
    return Batch(tuple(variables), tuple(factors))


def read_values(message: Map) -> tuple[Variables, ...]:
    """The variables in `message`, each with values.  Raises BadMessage.

    A kind this version does not know keeps its name and gets its row size from its bytes, so that an older
    client can follow a newer map.
    """
    return tuple(_read_variables(i, m, strict=False) for i, m in enumerate(fields.maps("", message, "variables")))


def _check_count(what: str, groups: Sequence[Variables] | Sequence[Factors], limit: int) -> None:
    count = 0
    for group in groups:
        count += len(group.keys)
    if count > limit:
        raise TooLarge("the batch", count, limit, what)


def _variables_map(group: Variables) -> dict[str, Any]:
    content: dict[str, Any] = {"kind": group.kind, "keys": _whole("variables", "keys", group.keys)}
    if group.values is not None:
        content["values"] = _bytes(group.values, F8)
    if group.fixed:
        content["fixed"] = True
    if group.stamps is not None:
        content["stamps"] = _whole("variables", "stamps", group.stamps)
    return content


def _factors_map(group: Factors) -> dict[str, Any]:
    content: dict[str, Any] = {
        "kind": group.kind,
        "keys": _whole("factors", "keys", group.keys),
        "measured": _bytes(group.measured, F8),
        "information": _bytes(group.information, F8),
    }
    if group.loss:
        content |= {"loss": group.loss, "scale": _bytes(group.scale, F8)}
    if group.ids is not None:
        content["ids"] = _whole("factors", "ids", group.ids)
    if group.trusted:
        content["trusted"] = True
    return content


def _whole(groups: str, name: str, column: Any) -> bytes:
    """A column of int64.  Raises BadStamp, BadMessage for what NumPy would cut to whole numbers."""
    if type(column) is np.ndarray and column.dtype == I8:
        return column.tobytes()
    numbers = np.asarray(column)
    wide = numbers.dtype.kind == "u" and numbers.size and numbers.max() > np.iinfo(np.int64).max
    if numbers.size and (numbers.dtype.kind not in "iu" or wide):
        seen = f"of {numbers.dtype}, {column!r:.60}"
        if name == "stamps":
            raise BadStamp(f"{groups}.{name}", seen)
        raise BadMessage(f"{groups}.{name}", seen, "integers from -2^63 to 2^63 - 1")
    return numbers.astype(I8).tobytes()


def _bytes(column: Any, dtype: np.dtype) -> bytes:
    if type(column) is np.ndarray and column.dtype == dtype:
        return column.tobytes()
    return np.asarray(column, dtype).tobytes()


def _read_variables(index: int, content: Map, strict: bool) -> Variables:
    def place() -> str:
        return f"variables[{index}]"

    kind = content.get("kind")
    known = VARIABLE_KINDS.get(kind) if type(kind) is str else None
    if known is None and (strict or type(kind) is not str):
        raise _kind_problem(place(), content, tuple(VARIABLE_KINDS))
    keys = fields.keys(place, content, 0)
    if strict and content.get("values") is None:
        values = None
    else:
        size = known.size if known else _row_size(content, len(keys))
        values = fields.rows(place, content, "values", len(keys), size)
    fixed = fields.flag(f"variables[{index}]", content, "fixed")
    stamps = None if content.get("stamps") is None else _read_numbers(place, content, "stamps", len(keys))
    return Variables(str(kind), keys, values, fixed, stamps)


def _read_factors(index: int, content: Map) -> Factors:
    def place() -> str:
        return f"factors[{index}]"

    kind = content.get("kind")
    known = FACTOR_KINDS.get(kind) if type(kind) is str else None
    if known is None:
        raise _kind_problem(place(), content, FACTOR_KINDS.names(kind if type(kind) is str else ""))
    keys = fields.keys(place, content, len(known.connects))
    measured = fields.rows(place, content, "measured", len(keys), known.size)
    information = fields.rows(place, content, "information", len(keys), known.information_size)
    ids = _read_numbers(place, content, "ids", len(keys)) if "ids" in content else None
    trusted = fields.flag(place(), content, "trusted") if "trusted" in content else False
    loss = content.get("loss")
    if loss is None:
        if content.get("scale") is not None:
            raise BadMessage(f"{place()}.scale", "a scale without a loss", f"loss: one of {', '.join(LOSSES)}")
        return Factors(known.name, keys, measured, information, ids=ids, trusted=trusted)
    if type(loss) is not str or loss not in LOSSES:
        if type(loss) is not str:
            raise BadMessage(f"{place()}.loss", "not a string", f"one of {', '.join(LOSSES)}, or no such field")
        raise BadLoss(f"{place()}.loss", repr(loss[:64]), f"one of {', '.join(LOSSES)}, or no such field")
    scale = fields.rows(place, content, "scale", len(keys), 1).reshape(-1)
    return Factors(known.name, keys, measured, information, loss, scale, ids, trusted)


def _read_numbers(place: Callable[[], str], content: Map, name: str, count: int) -> I64:
    """A column with one int64 for each row."""
    value = fields.binary(place(), content, name)
    if len(value) != 8 * count:
        raise BadMessage(f"{place()}.{name}", counted(len(value), "byte"), f"{8 * count} ({count} int64)")
    return np.ndarray((count,), I8, value)


def _row_size(content: Map, count: int) -> int:
    values = content.get("values")
    return len(values) // (8 * count) if count and type(values) is bytes else 0


def _kind_problem(where: str, content: Map, known: tuple[str, ...]) -> BadMessage:
    kind = content.get("kind")
    if type(kind) is str:
        return UnknownKind(f"{where}.kind", kind, known)
    return BadMessage(f"{where}.kind", "missing" if kind is None else "not a string", f"one of {', '.join(known)}")
