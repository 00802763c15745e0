"""A batch is checked and taken into the graph, whole or not at all."""

from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import Graph
from factorbus.solver.graph.groups import BatchLike
from factorbus.solver.graph.packing import Packing
from factorbus.solver.kernels.graph.admit_bytes import admit_bytes
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at


class Staging:
    """Takes batches into a graph."""

    def __init__(self, graph: Graph) -> None:
        self._graph, self._packing = graph, Packing()

    def stage(self, batch: BatchLike) -> int:
        """As `Solver.stage`."""
        packed = self._packing.pack(batch)
        if packed:
            first = self.try_stage(*packed)
            if first is not None:
                return first
        mark = self._graph.mark()
        try:
            admit(self._graph, batch)
        except BaseException:
            self._graph.forget(mark)
            raise
        return mark[at.FACTORS] + self._graph.id_shift

    def try_stage(self, raw: bytes, groups: I64) -> int | None:
        """As `Solver.try_stage`."""
        first = admit_bytes(raw, groups, self._graph.array_table)
        if first == at.NO_ROOM:
            self._graph.make_room(groups)
            first = admit_bytes(raw, groups, self._graph.array_table)
        return None if first < 0 else first + self._graph.id_shift
