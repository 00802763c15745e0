"""The values of a map's variables as far as they are held here, by kind.  Pure."""

from collections.abc import Iterable

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.table import Table


class HeldValues:
    """Of one estimate, or of a part of it."""

    def __init__(self, groups: Iterable[Variables] = ()) -> None:
        self._tables: dict[str, Table] = {}
        self.put(groups)

    def put(self, groups: Iterable[Variables]) -> None:
        """Set the values of these variables, new ones included."""
        for group in groups:
            values = group.values
            if values is None or not len(group.keys):
                continue
            table = self._tables.get(group.kind)
            if table is None:
                table = self._tables[group.kind] = Table(values.shape[1])
            table.put(np.asarray(group.keys), values, group.stamps)

    def remove(self, groups: Iterable[Variables]) -> None:
        """Let go of these variables, those that are held."""
        for group in groups:
            table = self._tables.get(group.kind)
            if table is not None:
                table.remove(group.keys)
                if not table.count:
                    del self._tables[group.kind]

    def variables(self) -> tuple[Variables, ...]:
        """All, as groups of a message."""
        groups = []
        for kind, table in self._tables.items():
            stamps = table.stamps()
            groups.append(Variables(kind, *table.columns(), stamps=stamps if (stamps != NO_STAMP).any() else None))
        return tuple(groups)

    def find(self, key: int) -> tuple[str, F64] | None:
        """The kind of one variable, and a copy of its value."""
        for kind, table in self._tables.items():
            if (value := table.get(key)) is not None:
                return kind, value
        return None

    def stamp(self, key: int) -> int | None:
        """The time stamp of one variable, if it has one."""
        return next((stamp for table in self._tables.values() if (stamp := table.stamp(key)) is not None), None)

    def stamps(self) -> dict[str, I64]:
        """Copies of the time stamps by kind, in the order of `columns`."""
        return {kind: table.stamps() for kind, table in self._tables.items()}

    def columns(self) -> dict[str, tuple[I64, F64]]:
        """Copies of (keys, values) by kind, ordered by key."""
        return {kind: table.columns() for kind, table in self._tables.items()}

    def columns_of(self, kind: str) -> tuple[I64, F64] | None:
        """Copies of (keys, values) of one kind, ordered by key."""
        table = self._tables.get(kind)
        return None if table is None else table.columns()

    def count(self) -> int:
        """Number of variables."""
        return sum(table.count for table in self._tables.values())
