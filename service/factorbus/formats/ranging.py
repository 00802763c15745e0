"""When what only ranges tell of enters a replay: once they determine where it is.

A range is one number, and a point in the plane has two, one in space three; a robot that only ranges join to the others
has three or six, whatever it has driven on its own.  With too few, or all in one line, the solver would have to refuse
it.  So such a body, a point or the poses that odometry joins to each other, waits with its ranges, and enters at the
value that the file gives it: of where it is the ranges say too little to begin from.  With n the direction of a range
at these values and a the arm of its pose from the middle of the body, a body is determined where

    J = rows [ nᵀ, (a × n)ᵀ/ℓ ],   ℓ² = mean |a|²,   of a point  [ nᵀ ]

has no singular value below `_LEAST`: two ranges that meet at 0.14 rad have that.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import format_symbol

RANGES = tuple(name for name in FACTOR_KINDS if name.startswith("range_"))
_LEAST = 0.1
_DIMENSION = {"se2": 2, "point2": 2, "se3": 3, "point3": 3}


class Ranges:
    """The ranges of a graph: which variables they join, and whether they determine a body.

    lone (N,): points of which nothing but ranges tells; these enter as bodies of their own.
    """

    def __init__(self, batch: Batch, ends: Sequence[I64], fixed: np.ndarray) -> None:
        self._others: dict[int, list[int]] = defaultdict(list)
        placed = fixed.copy()
        for group, rows in zip(batch.factors, ends, strict=True):
            if group.kind not in RANGES:
                placed[rows.ravel()] = True
                continue
            for one, other in rows.tolist():
                self._others[one].append(other)
                self._others[other].append(one)
        self.lone = ~placed & _points(batch)
        self.lone[[row for row in range(len(placed)) if row not in self._others]] = False
        self._places, self._spaces = _places(batch)

    def __bool__(self) -> bool:
        return bool(self._others)

    def of(self, row: int) -> list[int]:
        """The variables that a range joins to a variable."""
        return self._others.get(row, [])

    def determine(self, body: Sequence[int], is_in: Callable[[int], bool]) -> bool:
        """Whether ranges to what is in determine where a body is, a point or poses that odometry joins."""
        pairs = [(row, other) for row in body for other in self.of(row) if is_in(other)]
        n = self._spaces[body[0]]
        is_point = bool(self.lone[body[0]])
        freedom = n if is_point else 3 * (n - 1)
        if len(pairs) < freedom:
            return False
        here, there = (self._places[[pair[end] for pair in pairs]][:, :n] for end in (0, 1))
        ways = here - there
        lengths = np.linalg.norm(ways, axis=1, keepdims=True)
        good = np.isfinite(lengths[:, 0]) & (lengths[:, 0] > 0)
        if good.sum() < freedom:
            return False
        J = ways[good] / lengths[good]
        if not is_point:
            arms = here[good] - here[good].mean(axis=0)
            size = float(np.sqrt((arms**2).sum(axis=1).mean()))
            turns = np.cross(arms, J) if n == 3 else (arms[:, :1] * J[:, 1:] - arms[:, 1:] * J[:, :1])
            J = np.concatenate([J, turns / size if size > 0 else 0.0 * turns], axis=1)
        return bool(np.linalg.eigvalsh(J.T @ J)[0] >= _LEAST**2)


def lone_ranges(batch: Batch) -> I64:
    """Keys of the points of which nothing tells but ranges from fewer poses than they have coordinates."""
    poses: dict[int, set[int]] = defaultdict(set)
    needed: dict[int, int] = {}
    known = {key for group in batch.variables if group.fixed for key in group.keys.tolist()}
    for group in batch.factors:
        end = FACTOR_KINDS[group.kind].connects[-1]
        if group.kind in RANGES and not VARIABLE_KINDS[end].is_pose:
            for pose, point in group.keys.tolist():
                poses[point].add(pose)
                needed[point] = _DIMENSION[end]
        elif group.kind not in RANGES:
            known.update(group.keys.ravel().tolist())
    return np.array([p for p, seen in poses.items() if len(seen) < needed[p] and p not in known], np.int64)


def refuse_unvalued(file: str, keys: I64, ranges: Ranges, valued: np.ndarray) -> None:
    """Refuse a point that only ranges see and that has no value to begin from.  Raises FormatError."""
    lost = ranges.lone & ~valued
    if lost.any():
        name = format_symbol(int(keys[np.argmax(lost)]))
        raise FormatError(file, None, f"{name} is seen by ranges alone and has no value", f"a vertex line for {name}")


def _points(batch: Batch) -> np.ndarray:
    flags = np.array([group.kind in ("point2", "point3") for group in batch.variables], bool)
    return np.repeat(flags, [len(group.keys) for group in batch.variables])


def _places(batch: Batch) -> tuple[F64, I64]:
    """(where each variable is by the file (N, 3), NaN where it does not say; how many coordinates that are (N,))."""
    places, spaces = [np.empty((0, 3))], [np.empty(0, np.int64)]
    for group in batch.variables:
        n = _DIMENSION.get(group.kind, 3)
        rows = np.full((len(group.keys), 3), np.nan)
        if group.values is not None:
            rows[:, :n] = group.values[:, :n]
        places.append(rows)
        spaces.append(np.full(len(group.keys), n))
    return np.concatenate(places), np.concatenate(spaces)
