"""One MessagePack map in, its fields out, each checked for its type and length; what is wrong is named by its place.

Decoding is on the path of every insert, so a place ("factors[1].keys") is put together only when it is needed.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgpack
import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.limits import MessageLimits
from factorbus.proto.problems import BadMessage, BadOption, TooLarge
from factorbus.wording import counted

F8 = np.dtype("<f8")
I8 = np.dtype("<i8")
MAX_INTEGER = (1 << 63) - 1
# A message this short cannot hold enough containers to matter, and is spared the counting.
_COUNTED_ABOVE = 65_536
MAX_NESTING = 1024  # of arrays and maps, by the decoder itself
_TOO_MANY = re.compile(r"(\d+) exceeds max_(?:array|map)_len")

Map = Mapping[str, Any]


def read_map(what: str, data: bytes, limits: MessageLimits) -> Map:
    """The MessagePack map that `data` is.  Raises TooLarge, BadMessage."""
    if len(data) > limits.max_bytes:
        raise TooLarge(what, len(data), limits.max_bytes, "bytes")
    hooks = _counting(what, limits.max_containers) if len(data) > _COUNTED_ABOVE else {}
    try:
        content = msgpack.unpackb(
            data, max_array_len=limits.max_elements, max_map_len=limits.max_elements, strict_map_key=True, **hooks
        )
    except msgpack.StackError:
        raise TooLarge(what, MAX_NESTING + 1, MAX_NESTING, "levels of nesting", "send it flatter") from None
    except (ValueError, TypeError, OverflowError) as error:
        if found := _TOO_MANY.match(str(error)):
            raise TooLarge(what, int(found[1]), limits.max_elements, "elements in one array or map") from None
        raise BadMessage(
            what, f"not readable ({_why_unreadable(error)})", "one MessagePack map, and nothing after it"
        ) from None
    if type(content) is not dict:
        raise BadMessage(what, f"is {_name(content)}", "a map")
    return content


def _why_unreadable(error: Exception) -> str:
    """What is wrong with the bytes, in the words of the format and not of the library that reads them."""
    said = str(error)
    if isinstance(error, msgpack.ExtraData):
        return "bytes follow the map"
    if isinstance(error, msgpack.FormatError):
        return "a byte 0xc1, which begins nothing in MessagePack"
    if isinstance(error, UnicodeDecodeError):
        return "a string that is not UTF-8"
    if "incomplete input" in said or "exceeds max_" in said:
        return "it ends too early"
    if "map key" in said or isinstance(error, TypeError):
        return "a key of a map that is no string"
    return "a time stamp that is none" if "timestamp" in said or "nanoseconds" in said else "a value that is none"


def integer(where: str, fields: Map, name: str, least: int = 0, default: int | None = None) -> int:
    """An integer from `least` to 2^63 - 1; `default` makes the field optional.  Raises BadMessage."""
    value = fields.get(name)
    if type(value) is int and least <= value <= MAX_INTEGER:
        return value
    if value is None and default is not None:
        return default
    raise BadMessage(_place(where, name), _seen(fields, name), f"an integer from {least} to 2^63 - 1")


def number(where: str, fields: Map, name: str) -> float:
    """A float; an integer will do.  Raises BadMessage."""
    value = fields.get(name)
    if type(value) is float or (type(value) is int and abs(value) <= MAX_INTEGER):
        return float(value)
    raise BadMessage(_place(where, name), _seen(fields, name), "a number")


def parameter(where: str, fields: Map, name: str, span: tuple[float, float], wanted: str, default: float) -> float:
    """An optional number from span[0] to span[1], both included.  Raises BadMessage, BadOption."""
    if fields.get(name) is None:
        return default
    value = number(where, fields, name)
    if not span[0] <= value <= span[1]:
        raise BadOption(_place(where, name), f"is {value:.17g}", wanted)
    return value


def choice_of(where: str, fields: Map, name: str, known: Sequence[str], default: str) -> str:
    """An optional string that is one of `known`.  Raises BadMessage, BadOption."""
    value = text(where, fields, name, default)
    if value not in known:
        raise BadOption(_place(where, name), f"is {value[:64]!r}", f"one of {', '.join(known)}")
    return value


def flag(where: str, fields: Map, name: str, default: bool = False) -> bool:
    """A boolean that is `default` when absent.  Raises BadMessage."""
    value = fields.get(name, default)
    if type(value) is bool:
        return value
    raise BadMessage(_place(where, name), _seen(fields, name), "true or false")


def text(where: str, fields: Map, name: str, default: str | None = None) -> str:
    """A string; `default` makes the field optional.  Raises BadMessage."""
    value = fields.get(name)
    if type(value) is str:
        return value
    if value is None and default is not None:
        return default
    raise BadMessage(_place(where, name), _seen(fields, name), "a string")


def binary(where: str, fields: Map, name: str) -> bytes:
    """A bin.  Raises BadMessage."""
    value = fields.get(name)
    if type(value) is bytes:
        return value
    raise BadMessage(_place(where, name), _seen(fields, name), "a bin")


def mapping(where: str, fields: Map, name: str) -> Map:
    """A map that is empty when absent.  Raises BadMessage."""
    value = fields.get(name)
    if value is None:
        return {}
    if type(value) is dict:
        return value
    raise BadMessage(_place(where, name), _seen(fields, name), "a map")


def maps(where: str, fields: Map, name: str) -> list[Map]:
    """An array of maps that is empty when absent.  Raises BadMessage."""
    value = fields.get(name)
    if value is None:
        return []
    if type(value) is not list:
        raise BadMessage(_place(where, name), _seen(fields, name), "an array of maps")
    for index, item in enumerate(value):
        if type(item) is not dict:
            raise BadMessage(f"{_place(where, name)}[{index}]", f"is {_name(item)}", "a map")
    return value


def keys(place: Callable[[], str], fields: Map, arity: int) -> I64:
    """The column `keys` as (n, arity); as (n,) when `arity` is 0.  Raises BadMessage."""
    value = fields.get("keys")
    width = 8 * (arity or 1)
    if type(value) is not bytes:
        raise BadMessage(f"{place()}.keys", _seen(fields, "keys"), "a bin of <i8")
    if len(value) % width:
        raise BadMessage(f"{place()}.keys", counted(len(value), "byte"), f"a multiple of {width}")
    count = len(value) // width
    return np.ndarray((count, arity) if arity else (count,), I8, value)


def rows(place: Callable[[], str], fields: Map, name: str, count: int, size: int) -> F64:
    """The column `name` as (count, size).  Raises BadMessage."""
    value = fields.get(name)
    if type(value) is not bytes:
        raise BadMessage(f"{place()}.{name}", _seen(fields, name), "a bin of <f8")
    if len(value) != 8 * count * size:
        raise BadMessage(
            f"{place()}.{name}",
            counted(len(value), "byte"),
            f"{8 * count * size} ({counted(count, 'row')} of {size} float64)",
        )
    return np.ndarray((count, size), F8, value)


def _counting(what: str, limit: int) -> dict[str, Callable[[Any], Any]]:
    """Hooks for msgpack that give up after `limit` containers."""
    seen = 0

    def count(container: Any) -> Any:
        nonlocal seen
        seen += 1
        if seen > limit:
            raise TooLarge(what, seen, limit, "arrays and maps")
        return container

    return {"object_hook": count, "list_hook": count}


def _place(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def _seen(fields: Map, name: str) -> str:
    if name not in fields:
        return "missing"
    value = fields[name]
    shown = repr(value) if isinstance(value, int | float) or (isinstance(value, str) and len(value) <= 40) else ""
    return f"is {_name(value)} {shown}".rstrip()


def _name(value: Any) -> str:
    """What MessagePack calls the type of `value`."""
    names = {dict: "a map", list: "an array", bytes: "a bin", str: "a string", int: "an integer", float: "a float"}
    names |= {bool: "a boolean", type(None): "nil"}
    return names.get(type(value), "an extension")
