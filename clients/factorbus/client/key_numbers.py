"""Keys of variables, ids of factors and time stamps as int64; one will do where a list of one is meant."""

import operator
from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.problems import BadShape, BadStamp, BadSymbol
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import parse_symbol

Key: TypeAlias = str | int
_TEXTS = (str, bytes, bytearray, memoryview)
_LOWEST, _HIGHEST = -(2**63), 2**63 - 1


def key_number(key: Key) -> int:
    """The int64 of "x12", or of a whole number.  Raises BadSymbol."""
    if isinstance(key, str):
        return parse_symbol(key)
    number = _whole(key)
    if number is None:
        raise BadSymbol(repr(key), "a text such as x12, or an int64")
    return number


def key_numbers(of: Iterable[Key] | Key) -> I64:
    """The int64 of each key; of one, an array of one.  Raises BadSymbol."""
    if isinstance(of, np.ndarray) and of.ndim and of.dtype.kind == "i" and not np.ma.is_masked(of):
        return of.astype(np.int64).reshape(-1)
    return np.array([key_number(key) for key in _each(of)], np.int64)


def as_list(where: str, of: Any, more: tuple[Any, ...]) -> Any:
    """`of`, one or a list, of which nothing stands behind it.  Raises BadShape: several were given one by one."""
    if more:
        given = ", ".join(repr(each)[:40] for each in (of, *more))
        raise BadShape(where, f"{given}, one by one", f"a list: {where}([{given}])")
    return of


def id_numbers(where: str, factors: Iterable[int] | int) -> I64:
    """The ids of factors; of one, an array of one.  Raises BadShape."""
    found = []
    for each in _each(factors):
        if (number := _whole(each)) is None or number < 0:
            raise BadShape(where, f"factor {each!r}", "ids of factors: whole numbers, 0 or more")
        found.append(number)
    return np.array(found, np.int64)


def stamp_number(where: str, stamp: int | None) -> int:
    """A time stamp in nanoseconds as the wire has it; None: the variable has none.  Raises BadStamp."""
    if stamp is None:
        return NO_STAMP
    number = _whole(stamp)
    if number is None or number == NO_STAMP:
        raise BadStamp(where, f"{stamp!r:.60} ({type(stamp).__name__})")
    return number


def _each(given: Any) -> Iterable[Any]:
    if isinstance(given, _TEXTS) or not hasattr(given, "__iter__") or getattr(given, "ndim", 1) == 0:
        return (given,)
    return given


def _whole(given: Any) -> int | None:
    """`given` as an int64, or None."""
    if isinstance(given, (bool, np.bool_)):
        return None
    try:
        number = operator.index(given)
    except TypeError:
        return None
    return number if _LOWEST <= number <= _HIGHEST else None
