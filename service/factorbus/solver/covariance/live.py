"""Covariances of a few variables from the tree as it stands between two steps, without copying it.  MATH §10.2."""

import numpy as np

from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.covariance.kernels.looked_back import find_contradicted
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.covariance.square_root import DIMS
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.closures.back import Bools
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at


class Live:
    """What the last step left.  For the thread that steps."""

    def __init__(self, graph: FactorGraph, tree: CliqueTree) -> None:
        self._graph, self._tree = graph, tree

    def contradicted(
        self, is_tested: Bools, looked_at: tuple[int, int, int], ends: I64, columns: tuple[F64, F64, F64], most: float
    ) -> int:
        """See `find_contradicted`."""
        tables = self._graph.array_table, self._tree.array_table
        return find_contradicted(is_tested, looked_at, ends, columns, *tables, DIMS, most)

    def joint(self, variables: I64, scalars: int | None = None) -> F64:
        """(d, d): of different free variables together, in their order; scalars: d, where that is known."""
        tree, var, size = self._tree, self._graph.var, scalars
        if size is None:
            size = sum(int(DIMS[var[v, at.V_KIND]]) for v in variables.tolist())
        out = np.empty((size, size))
        joint_block(variables, var, DIMS, tree.array_table, out)
        return out
