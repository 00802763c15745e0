"""After a long step, a short one is gone through that nobody asked for.  MATH §9.9.

A step that moves thousands of variables has filled the caches with their numbers.  What a short step reads and runs is
not there any more: the newest rows of every arena, the root, the code of admission and elimination; and the next one
would take three times as long as others.  So a motion that nobody has measured is admitted, taken in and eliminated,
up to where the tree would change, and taken back as what fails is.
"""

import numpy as np

from factorbus.solver.admission import try_admit
from factorbus.solver.graph import Graph
from factorbus.solver.groups import Addition, FactorGroup, Group
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import I64
from factorbus.solver.packing import Packing
from factorbus.solver.tree import Tree

# The key of the pose that never comes.  In a map that has it nothing is rehearsed: admission refuses it.
NOBODY = np.iinfo(np.int64).min + 1
_BACK = 16  # the newest variables, among which a pose is looked for


class Rehearsal:
    """Goes through a step of one pose and one factor, and leaves the graph and its tree as they were."""

    def __init__(self, graph: Graph, tree: Tree, packing: Packing) -> None:
        self._graph, self._tree, self._packing = graph, tree, packing
        self._ends: I64 = np.array([[0, NOBODY]])
        self._motions = {
            at.SE2: _motion("se2", self._ends, [0.0] * 3),
            at.SE3: _motion("se3", self._ends, [0.0] * 6 + [1.0]),
        }

    def run(self) -> None:
        """Between steps, with nothing staged."""
        graph, v = self._graph, self._newest_pose()
        if v < 0:
            return
        self._ends[0, 0] = graph.keys[v]
        packed = self._packing.pack(self._motions[graph.var.item(v, at.V_KIND)])
        mark = graph.mark()
        if packed and try_admit(graph, *packed) is not None:
            self._tree.rehearse()
            graph.forget(mark)
            graph.variables(np.arange(max(v - _BACK, 0), v + 1))

    def _newest_pose(self) -> int:
        """−1: none among the newest variables."""
        graph = self._graph
        newest = graph.counts.item(at.VARIABLES) - 1
        for v in range(newest, max(newest - _BACK, -1), -1):
            if graph.var.item(v, at.V_KIND) in self._motions:
                return v
        return -1


def _motion(kind: str, ends: I64, measured: list[float]) -> Addition:
    """A new pose where the one before it is."""
    dim = 3 if kind == "se2" else 6
    information = np.eye(dim)[np.triu_indices(dim)]
    factor = FactorGroup(f"between_{kind}", ends, np.array([measured]), information[None])
    return Addition((Group(kind, ends[0, 1:], None),), (factor,))  # type: ignore[arg-type]
