"""A graph as a file has it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.parallax import lone_bearings
from factorbus.formats.ranging import lone_ranges
from factorbus.formats.robot_log import RobotLog
from factorbus.formats.steps import Steps, at_once, planned, planned_whole
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
    log: what a JRL file has beside the graph; of it factor_lines are the turns of the factors, by their stamps.
    """

    path: str
    dialect: str
    batch: Batch
    factor_lines: tuple[I64, ...]
    notes: tuple[str, ...] = ()
    left_out: Mapping[str, int] = field(default_factory=dict)
    numbering: str = "ids"
    log: RobotLog | None = None

    @property
    def poses(self) -> int:
        """Number of poses."""
        return sum(len(group.keys) for group in self.batch.variables if group.kind in ("se2", "se3"))

    @property
    def landmarks(self) -> int:
        """Number of points."""
        of = ("point2", "point3", "idp")
        return sum(len(group.keys) for group in self.batch.variables if group.kind in of)

    def steps(self, use_values: bool = False) -> Steps:
        """The replay of the file in time order (see `steps.Steps`).  Raises FormatError for a graph in parts."""
        if self.dialect == "bal":
            return at_once(self.batch)
        return planned(self.path, *self._joined(), use_values)

    def whole(self, use_values: bool = True) -> Batch:
        """All steps as one insert, with the first pose fixed where the file leaves the choice.  Raises FormatError."""
        if self.dialect == "bal":
            return self.batch
        batch, lines, _ = self._joined()
        return planned_whole(self.path, batch, lines, use_values)

    def summary(self, whole: bool = False) -> dict[str, object]:
        """A program's summary of how the file was read; whole: of all in `batch`, not of what a replay drives."""
        left_out = {name: count for name, count in self.left_out.items() if not (whole and name in _IN_NO_STEP)}
        beside = {} if self.log is None else self.log.counts()
        return {"dialect": self.dialect, "notes": list(self.notes), "left_out": left_out, **beside}

    def _joined(self) -> tuple[Batch, tuple[I64, ...], tuple[I64, ...]]:
        """The graph, and lines and times of its factors, without what nothing is known of.  Raises FormatError."""
        if self.dialect in ("tum", "colmap", "nuscenes") and not self.batch.factors:
            raise FormatError(self.path, None, "a trajectory, which has no measurements", "a graph, with its factors")
        if not self.batch.factors:
            if not self.poses:
                raise FormatError(self.path, None, "no pose", "at least one pose")
            return self.batch, self.factor_lines, ()
        times = () if self.log is None else tuple(labels.stamps for labels in self.log.labels)
        lost = np.concatenate([unnamed(self.batch), lone_bearings(self.batch), lone_ranges(self.batch)])
        if not lost.size:
            return self.batch, self.factor_lines, times
        lines, times = (_left(self.batch, columns, lost) for columns in (self.factor_lines, times))
        return _without(self.batch, lost), lines, times


def unnamed(batch: Batch) -> I64:
    """Keys of the variables that no factor names, but for fixed ones, which are known."""
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in batch.factors)])
    free = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables if not group.fixed)])
    return free[~np.isin(free, named)]


def _without(batch: Batch, keys: I64) -> Batch:
    """The same without some variables and all factors on them."""
    variables, factors = [], []
    for group in batch.variables:
        kept = ~np.isin(group.keys, keys)
        if kept.any():
            values = None if group.values is None else group.values[kept]
            stamps = None if group.stamps is None else group.stamps[kept]
            variables.append(group._replace(keys=group.keys[kept], values=values, stamps=stamps))
    for group in batch.factors:
        kept = ~np.isin(group.keys, keys).any(axis=1)
        if kept.any():
            scale = None if group.scale is None else group.scale[kept]
            rows = {"keys": group.keys[kept], "measured": group.measured[kept], "information": group.information[kept]}
            factors.append(group._replace(**rows, scale=scale))
    return Batch(tuple(variables), tuple(factors))


def _left(batch: Batch, columns: tuple[I64, ...], keys: I64) -> tuple[I64, ...]:
    """What is said of the factors that `_without` leaves: one array for each of its groups, if there are any."""
    kept = [
        column[~np.isin(group.keys, keys).any(axis=1)] for group, column in zip(batch.factors, columns, strict=False)
    ]
    return tuple(column for column in kept if column.size)
