"""What of an estimate somebody wants to follow: an interest, and which variables it is in.  Pure.

An interest is a filter (letters of keys, kinds, a box) and what its channel may carry (period, bytes per second).
Equal interests have one channel, named by the content.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import blake2b
from numbers import Real
from typing import NamedTuple

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Variables
from factorbus.proto.problems import BadOption, UnknownKind
from factorbus.proto.symbols import symbol_parts
from factorbus.proto.variable_kinds import VARIABLE_KINDS
from factorbus.wording import counted

PERIOD_MS = (10, 60_000)
BYTES_PER_S = (1000, 1 << 40)
_MOST_LETTERS = 53  # of the alphabet, large and small, and none
_FAR = 1e12  # no number of a value is larger
_LETTER_BITS = 56


@dataclass(frozen=True, slots=True)
class Interest:
    """Which variables, and how fast.  What is empty, or 0, filters and bounds nothing.

    letters: of keys, as "xl" or ("x", "l"); "" is that of keys without a letter.
    kinds: of variables, as "se2" or ("se2", "point2").
    box: the corners with the lowest and the highest coordinates, metres: x y, x y or x y z, x y z.  A variable is in it
    by its position; one that has none (a rotation, a vector) is in no box.
    period_ms: changes are merged for so long.  bytes_per_s: what the channel carries at most, 0: not bounded.
    """

    letters: Iterable[str] = ()
    kinds: Iterable[str] = ()
    box: Iterable[float] = ()
    period_ms: int = 100
    bytes_per_s: int = 0


class InterestFilter(NamedTuple):
    """The part of an interest that says which variables, checked and in one order."""

    letters: tuple[str, ...]
    kinds: tuple[str, ...]
    box: tuple[float, ...]

    def mask(self, kind: str, keys: I64, values: F64) -> np.ndarray:
        """Which (n,) of the variables of one kind are in it."""
        mask = np.ones(len(keys), bool)
        if self.kinds and kind not in self.kinds:
            return np.zeros(len(keys), bool)
        if self.letters:
            mask &= np.isin(_letter_codes(keys), [ord(letter) if letter else 0 for letter in self.letters])
        if self.box:
            position, half = _positions(kind, values), len(self.box) // 2
            if position is None:
                return np.zeros(len(keys), bool)
            for axis in range(min(half, position.shape[1])):
                mask &= (position[:, axis] >= self.box[axis]) & (position[:, axis] <= self.box[half + axis])
        return mask

    def pick(self, groups: Iterable[Variables]) -> tuple[Variables, ...]:
        """The variables of `groups` that are in it."""
        picked = []
        for group in groups:
            if group.values is not None and (mask := self.mask(group.kind, group.keys, group.values)).any():
                stamps = None if group.stamps is None else group.stamps[mask]
                picked.append(group._replace(keys=group.keys[mask], values=group.values[mask], stamps=stamps))
        return tuple(picked)


def checked_interest(interest: Interest, where: str = "interest") -> Interest:
    """`interest` in the one form that all equal ones have.  Raises BadOption, UnknownKind."""
    letters, kinds, box = _filter_parts(interest, where)
    for name, span in (("period_ms", PERIOD_MS), ("bytes_per_s", BYTES_PER_S)):
        value = getattr(interest, name)
        if type(value) is not int or not (span[0] <= value <= span[1] or (name == "bytes_per_s" and value == 0)):
            more = ", or 0 for no bound" if name == "bytes_per_s" else ""
            raise BadOption(f"{where}.{name}", f"is {value!r:.40}", f"a whole number from {span[0]} to {span[1]}{more}")
    return Interest(letters, kinds, box, interest.period_ms, interest.bytes_per_s)


def filter_of(interest: Interest, where: str = "interest") -> InterestFilter:
    """Which variables `interest` is about.  Raises BadOption, UnknownKind."""
    return InterestFilter(*_filter_parts(interest, where))


def channel_of(interest: Interest) -> str:
    """The channel of a checked interest."""
    parts = (interest.letters, interest.kinds, interest.box, interest.period_ms, interest.bytes_per_s)
    return f"interest-{blake2b(repr(parts).encode(), digest_size=8).hexdigest()}"


def _filter_parts(interest: Interest, where: str) -> tuple[tuple[str, ...], tuple[str, ...], tuple[float, ...]]:
    letters = _words(interest.letters, f"{where}.letters")
    given = interest.kinds
    kinds = _words([given] if isinstance(given, str) and given else given, f"{where}.kinds")
    for letter in letters:
        if len(letter) > 1 or (letter and not (letter.isascii() and letter.isalpha())):
            raise BadOption(f"{where}.letters", f"has {letter[:40]!r}", 'ASCII letters, and "" for keys without one')
    for kind in kinds:
        if kind not in VARIABLE_KINDS:
            raise UnknownKind(f"{where}.kinds", kind, tuple(VARIABLE_KINDS))
    return letters, kinds, _box(interest.box, f"{where}.box")


def _words(given: Iterable[str], where: str) -> tuple[str, ...]:
    try:
        words = tuple(given)
    except TypeError:
        raise BadOption(where, f"is {given!r:.40}", "a list of strings") from None
    for word in words:
        if type(word) is not str:
            raise BadOption(where, f"has {word!r:.40}", "strings")
    return tuple(sorted(set(words)))


def _box(given: Iterable[float], where: str) -> tuple[float, ...]:
    try:
        numbers = tuple(given)
        if not all(isinstance(each, Real) and not isinstance(each, bool) for each in numbers):
            raise TypeError  # float would read a text, too
        box = tuple(float(each) + 0.0 for each in numbers)  # −0 as 0
    except (TypeError, ValueError, OverflowError):
        raise BadOption(where, f"is {given!r:.60}", "4 or 6 numbers") from None
    if len(box) not in (0, 4, 6):
        wanted = "4 or 6: the lowest x y (z) and the highest x y (z)"
        raise BadOption(where, f"has {counted(len(box), 'number')}", wanted)
    half = len(box) // 2
    for low, high in zip(box[:half], box[half:], strict=True):
        if not (math.isfinite(low) and math.isfinite(high) and -_FAR <= low <= high <= _FAR):
            wanted = "the corner with the lowest coordinates and then that with the highest, within 1e12"
            raise BadOption(where, f"goes from {low:g} to {high:g}", wanted)
    return box


def _letter_codes(keys: I64) -> I64:
    """The code of each key's letter, 0 without."""
    codes = keys >> _LETTER_BITS
    return np.where(_IS_LETTER[codes & 0x7F] & (codes > 0), codes, 0)


def _positions(kind: str, values: F64) -> F64 | None:
    """Where variables are (n, 2 or 3), metres in the map; NaN of a point at infinity.  None: they have no place."""
    if kind in ("se2", "point2"):
        return values[:, :2]
    if kind in ("se3", "sim3", "point3"):
        return values[:, :3]
    if kind == "idp":
        theta, phi, rho = values[:, 3], values[:, 4], values[:, 5]
        ray = np.stack([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)], axis=1)
        return values[:, :3] + ray / np.where(rho > 0.0, rho, np.nan)[:, None]
    return None


_IS_LETTER = np.array([bool(symbol_parts(code << _LETTER_BITS)[0]) for code in range(128)])
