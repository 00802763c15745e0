"""Covariances of a few variables from the tree as it stands between two steps, without copying it.  MATH §10.2."""

import numpy as np

from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.covariance.square_root import DIMS
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at


class Live:
    """What the last step left.  For the thread that steps."""

    def __init__(self, graph: FactorGraph, tree: CliqueTree) -> None:
        self._graph, self._tree = graph, tree

    def joint(self, variables: I64) -> F64:
        """(d, d): of different free variables together, in their order."""
        tree, var = self._tree, self._graph.var
        size = 0
        for v in variables.tolist():
            size += int(DIMS[var[v, at.V_KIND]])
        out = np.empty((size, size))
        joint_block(variables, var, DIMS, tree.array_table, out)
        return out
