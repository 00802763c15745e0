"""The whole estimate of a map at one revision."""

from dataclasses import dataclass

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Variables
from factorbus.proto.stamps import NO_STAMP


@dataclass(frozen=True, slots=True)
class Snapshot:
    """An estimate at one revision: {kind: (keys (n,), values (n, size))}, ordered by key.

    stamps: {kind: (n,)}, the time stamps in the same order, nanoseconds; NO_STAMP (-2^63) of a variable without.
    """

    epoch: int
    revision: int
    columns: dict[str, tuple[I64, F64]]
    stamps: dict[str, I64]

    def variables(self) -> tuple[Variables, ...]:
        """The same as groups of a message, one for each kind."""
        groups = (Variables(kind, *columns, stamps=self.stamps[kind]) for kind, columns in self.columns.items())
        return tuple(g if (g.stamps != NO_STAMP).any() else g._replace(stamps=None) for g in groups)
