"""A graph as a file has it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.parallax import lone_bearings
from factorbus.formats.ranging import lone_ranges
from factorbus.formats.steps import Steps, planned, planned_whole
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch

_IN_NO_STEP = ("vertices", "points")  # of `left_out`: these are in the batch


@dataclass(frozen=True, slots=True)
class GraphFile:
    """What `read` found.

    batch: all variables (values where the file has a vertex line) and all factors, per kind and loss in the order of
    the file; fixed is what FIX lines say, and nothing else.  factor_lines: the line of each factor, one array for each
    group of batch.factors.  notes: what was left out, assumed or turned into something else, for people; left_out: how
    many lines of each record were, "vertices" that no edge names, and "points" that a single bearing sees: those two
    stay in `batch`, and are in no step.
    numbering: "ids" (keys are letters and ids), "apart" (the same, poses and points numbered separately) or "keys" (ids
    are keys): what `write_g2o` takes to write the same ids.
    """

    path: str
    dialect: str
    batch: Batch
    factor_lines: tuple[I64, ...]
    notes: tuple[str, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)
    numbering: str = "ids"

    @property
    def poses(self) -> int:
        """Number of poses."""
        return sum(len(group.keys) for group in self.batch.variables if group.kind in ("se2", "se3"))

    @property
    def landmarks(self) -> int:
        """Number of points."""
        return self.batch.variable_count - self.poses

    def steps(self, use_values: bool = False) -> Steps:
        """The replay of the file in time order (see `steps.Steps`).  Raises FormatError for a graph in parts."""
        return planned(self.path, *self._joined(), use_values)

    def whole(self, use_values: bool = True) -> Batch:
        """All steps as one insert, with the first pose fixed where the file leaves the choice.  Raises FormatError."""
        return planned_whole(self.path, *self._joined(), use_values)

    def summary(self, whole: bool = False) -> dict[str, object]:
        """A program's summary of how the file was read; whole: of all in `batch`, not of what a replay drives."""
        left_out = {name: count for name, count in self.left_out.items() if not (whole and name in _IN_NO_STEP)}
        return {"dialect": self.dialect, "notes": list(self.notes), "left_out": left_out}

    def _joined(self) -> tuple[Batch, tuple[I64, ...]]:
        """The graph, and the lines of its factors, without what nothing is known of.  Raises FormatError."""
        if self.dialect == "tum":
            raise FormatError(self.path, None, "a trajectory, which has no measurements", "a graph, with its factors")
        if not self.batch.factors:
            if not self.poses:
                raise FormatError(self.path, None, "no pose", "at least one pose to replay")
            return self.batch, self.factor_lines
        lost = np.concatenate([unnamed(self.batch), lone_bearings(self.batch), lone_ranges(self.batch)])
        return _without(self.batch, self.factor_lines, lost) if lost.size else (self.batch, self.factor_lines)


def unnamed(batch: Batch) -> I64:
    """Keys of the variables that no factor names, but for fixed ones, which are known."""
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in batch.factors)])
    free = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables if not group.fixed)])
    return free[~np.isin(free, named)]


def _without(batch: Batch, lines: tuple[I64, ...], keys: I64) -> tuple[Batch, tuple[I64, ...]]:
    """The same without some variables and all factors on them."""
    variables, factors, left = [], [], []
    for group in batch.variables:
        kept = ~np.isin(group.keys, keys)
        if kept.any():
            values = None if group.values is None else group.values[kept]
            stamps = None if group.stamps is None else group.stamps[kept]
            variables.append(group._replace(keys=group.keys[kept], values=values, stamps=stamps))
    for group, at in zip(batch.factors, lines, strict=True):
        kept = ~np.isin(group.keys, keys).any(axis=1)
        if kept.any():
            scale = None if group.scale is None else group.scale[kept]
            rows = {"keys": group.keys[kept], "measured": group.measured[kept], "information": group.information[kept]}
            factors.append(group._replace(**rows, scale=scale))
            left.append(at[kept])
    return Batch(tuple(variables), tuple(factors)), tuple(left)
