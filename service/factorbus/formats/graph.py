"""A graph as a file has it."""

from dataclasses import dataclass

from factorbus.formats.steps import Steps, planned, planned_whole
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch


@dataclass(frozen=True, slots=True)
class GraphFile:
    """What `read` found.

    batch: all variables (values where the file has a vertex line) and all factors, per kind in the order of the
    file; fixed is what FIX lines say, and nothing else.  factor_lines: the line of each factor, one array for each
    group of batch.factors.  notes: what was left out, for people.
    """

    path: str
    dialect: str
    batch: Batch
    factor_lines: tuple[I64, ...]
    notes: tuple[str, ...] = ()

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
        return planned(self.path, self.batch, self.factor_lines, use_values)

    def whole(self, use_values: bool = True) -> Batch:
        """All steps as one insert, with the first pose fixed where the file leaves the choice.  Raises FormatError."""
        return planned_whole(self.path, self.batch, self.factor_lines, use_values)
