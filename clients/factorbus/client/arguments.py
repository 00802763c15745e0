"""What a call is given, held against what it takes: another type is refused by name, before it is sent."""

import math
import threading
import types
from collections.abc import Iterable, Sequence
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.nearest import nearest
from factorbus.proto.problems import BadOption, BadShape, NotFiniteNumbers

T = TypeVar("T")
_FEW = 12  # numbers that are shown whole
_NO_NUMBERS = types.MappingProxyType(
    {"U": "text", "S": "text", "c": "complex numbers", "M": "times", "m": "durations", "V": "records"}
)
_PLAIN = (str, bytes, int, float, complex, list, tuple, dict, type(None))


def of_type(what: str, given: Any, kind: type[T] | tuple[type[T], ...], wanted: str) -> T:
    """`given`, if it is of this kind.  Raises BadOption."""
    if not isinstance(given, kind):
        raise BadOption(what, seen(given), wanted)
    return given


def checked_flag(what: str, given: Any) -> bool:
    """True or False, numpy's too; no other value is taken for one of the two.  Raises BadOption."""
    if not isinstance(given, (bool, np.bool_)):
        raise BadOption(what, seen(given), "True or False")
    return bool(given)


def checked_seconds(what: str, given: Any, usual: float) -> float:
    """How long to wait; None: as long as usual.  Raises BadOption."""
    if given is None:
        return usual
    return _seconds(what, given, "seconds: a finite number, 0 or more; or None, for as long as usual")


def checked_duration(what: str, given: Any) -> float:
    """How long something takes, in seconds.  Raises BadOption."""
    return _seconds(what, given, "seconds: a finite number, 0 or more")


def as_numbers(what: str, given: Any, wanted: str = "numbers", *, copy: bool = True) -> F64:
    """`given` as an array of floats, of any shape.  Raises BadShape.

    NumPy would read a text as a number, a time as one of whatever unit it has, of a complex number the real part,
    and of a masked array what the mask hides: none of these is taken.  copy: False where nobody keeps it.
    """
    try:
        seen_as = np.asarray(given)
        mixed = seen_as.dtype.kind == "O"
        for kind in map(_kind_of, seen_as.flat) if mixed else (seen_as.dtype.kind,):
            if kind in _NO_NUMBERS:
                raise BadShape(what, repr(given)[:80], f"{wanted}, not {_NO_NUMBERS[kind]}")
        if isinstance(given, np.ma.MaskedArray) and np.ma.is_masked(given):
            raise BadShape(what, repr(given)[:80], f"{wanted}, none of which is masked")
        return np.array(given, np.float64, copy=True if copy else None)
    except (TypeError, ValueError, OverflowError):
        raise BadShape(what, repr(given)[:80], wanted) from None


def as_row(number: Any) -> Any:
    """One number as a row of one; what is a row already as it is, so that an error says the shape that was given."""
    return number if isinstance(number, list | tuple) or (isinstance(number, np.ndarray) and number.ndim) else [number]


def all_finite(what: str, numbers: F64) -> F64:
    """`numbers`, if none of them is a NaN or an infinity.  Raises NotFiniteNumbers."""
    if not np.isfinite(numbers).all():
        raise NotFiniteNumbers(what, _first_not_finite(numbers))
    return numbers


def checked_row(what: str, numbers: Any, size: int) -> F64:
    """`numbers` as `size` floats, all finite.  Raises BadShape, NotFiniteNumbers."""
    row = as_numbers(what, numbers, f"({size},) numbers")
    if row.shape != (size,):
        raise BadShape(what, f"shape {row.shape}", f"({size},)")
    return all_finite(what, row)


def checked_probability(what: str, given: Any) -> float:
    """Between 0 and 1, neither of the two.  Raises BadOption."""
    number = _real(given)
    if not 0.0 < number < 1.0:
        raise BadOption(what, seen(given), "a number between 0 and 1")
    return number


def checked_number(what: str, given: Any) -> float:
    """One finite number.  Raises BadOption."""
    number = _real(given)
    if not math.isfinite(number):
        raise BadOption(what, seen(given), "a finite number")
    return number


def checked_bound(what: str, given: Any) -> float:
    """0 or more, and finite.  Raises BadOption."""
    number = _real(given)
    if not 0.0 <= number < math.inf:
        raise BadOption(what, seen(given), "a finite number, 0 or more")
    return number


def checked_keywords(what: str, given: Iterable[str], wanted: Sequence[str]) -> None:
    """A misspelt keyword must not be ignored.  Raises BadOption."""
    for name in given:
        if name not in wanted:
            raise BadOption(what, f"there is no keyword {name!r}", f"{', '.join(wanted)}{nearest(name, wanted)}")


def _seconds(what: str, given: Any, wanted: str) -> float:
    number = _real(given)
    if not 0.0 <= number <= threading.TIMEOUT_MAX:
        raise BadOption(what, seen(given), wanted)
    return number


def _real(given: Any) -> float:
    """A number as a float; NaN for anything else, for True too."""
    if isinstance(given, (bool, np.bool_)) or not isinstance(given, Real):
        return math.nan
    try:
        return float(given)
    except OverflowError:  # a whole number beyond all floats
        return math.nan


def _kind_of(given: Any) -> str:
    """NumPy's letter for what one thing is."""
    return np.asarray(given).dtype.kind


def _first_not_finite(numbers: F64) -> str:
    """All of a few numbers; of many where the first one is that is none."""
    if numbers.size <= _FEW:
        return repr(numbers.tolist())[:80]
    bad = np.argwhere(~np.isfinite(numbers))
    more = f", the first of {len(bad)}" if len(bad) > 1 else ""
    at = ", ".join(map(str, bad[0].tolist()))
    return f"{numbers[tuple(bad[0])]} at [{at}]{more}, of shape {numbers.shape}"


def seen(given: Any) -> str:
    """What it is, in a few words."""
    name = type(given).__name__
    return f"{given!r:.60} ({name})" if isinstance(given, (*_PLAIN, np.generic)) else f"an object of type {name}"
