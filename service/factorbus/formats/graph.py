"""A graph as a file has it."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.steps import Steps, planned, planned_whole
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch


@dataclass(frozen=True, slots=True)
class GraphFile:
    """What `read` found.

    batch: all variables (values where the file has a vertex line) and all factors, per kind and loss in the order of
    the file; fixed is what FIX lines say, and nothing else.  factor_lines: the line of each factor, one array for each
    group of batch.factors.  notes: what was left out, assumed or turned into something else, for people; left_out: how
    many lines of each record were, and "vertices" that no edge names: those stay in `batch`, and are in no step.
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
        return planned(self.path, self._joined(), self.factor_lines, use_values)

    def whole(self, use_values: bool = True) -> Batch:
        """All steps as one insert, with the first pose fixed where the file leaves the choice.  Raises FormatError."""
        return planned_whole(self.path, self._joined(), self.factor_lines, use_values)

    def account(self) -> dict[str, object]:
        """What a program is told of how the file was read."""
        return {"dialect": self.dialect, "notes": list(self.notes), "left_out": dict(self.left_out)}

    def _joined(self) -> Batch:
        """The graph without the vertices that no edge names.  Raises FormatError when it has no edge."""
        if not self.batch.factors:
            if not self.poses:
                raise FormatError(self.path, None, "no pose", "at least one pose to replay")
            return self.batch
        return without(self.batch, unnamed(self.batch))


def unnamed(batch: Batch) -> I64:
    """Keys of the variables that no factor names, but for fixed ones, which are known."""
    named = np.concatenate([np.empty(0, np.int64), *(group.keys.ravel() for group in batch.factors)])
    free = np.concatenate([np.empty(0, np.int64), *(group.keys for group in batch.variables if not group.fixed)])
    return free[~np.isin(free, named)]


def without(batch: Batch, keys: I64) -> Batch:
    """`batch` without some variables that no factor names."""
    groups = []
    for group in batch.variables:
        kept = ~np.isin(group.keys, keys)
        if kept.any():
            values = None if group.values is None else group.values[kept]
            groups.append(group._replace(keys=group.keys[kept], values=values))
    return Batch(tuple(groups), batch.factors)
