"""R of a map at one moment, copied: what covariances are computed from while the map goes on.  MATH §10."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver import errors
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.covariance.kernels.recursion import list_cliques
from factorbus.solver.covariance.kernels.rows import copy_rows, size_of_rows
from factorbus.solver.covariance.orthogonal import replace_rows
from factorbus.solver.graph.arenas import Arenas
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first
from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.records import Tree
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.options import Options

DIMS = np.zeros(1 + max(kind.code for kind in VARIABLE_KINDS.values()), np.int64)
for _kind in VARIABLE_KINDS.values():
    DIMS[_kind.code] = _kind.dim
LARGEST = int(DIMS.max())


class CliqueRows(Arenas):
    """The rows of R by cliques, copied from a tree: of its arrays those that covariances are computed from."""

    ARENAS = Tree._fields

    def __init__(self, node: I64, clique: I64, lists: I64, numbers: F64) -> None:
        self.node, self.clique, self.lists, self.numbers = node, clique, lists, numbers


@dataclass(frozen=True, slots=True)
class SquareRoot:
    """R by cliques and the graph it is of; arrays as in `kernels/bayes_tree/layout.py`.

    dims (n,): of every variable   scalar (n,): where it starts in a column of Σ; −1: fixed
    order (c,): the cliques, depth first from the roots; none in a view   stamp: of the last elimination
    """

    graph: FactorGraph
    tree: CliqueRows | CliqueTree
    dims: I64
    scalar: I64
    order: I64
    stamp: int

    @property
    def count(self) -> int:
        """Variables, fixed ones included."""
        return len(self.dims)


def copied_square_root(graph: FactorGraph, tree: CliqueTree) -> SquareRoot:
    """A copy of what `tree` has of `graph`, as of its last step."""
    return _copied(graph.copied(), tree)


def viewed_square_root(graph: FactorGraph, tree: CliqueTree) -> SquareRoot:
    """The same in place, until the next step: for what goes up from a few variables."""
    var = graph.var[: graph.counts[at.VARIABLES]]
    scalar = np.ascontiguousarray(var[:, at.V_SCALAR])
    return SquareRoot(graph, tree, variable_dims(var), scalar, np.empty(0, np.int64), int(tree.state[tl.S_STAMP]))


def computed_square_root(graph: FactorGraph) -> SquareRoot:
    """The same for a graph that is solved in another way, or whose R is rounding: factorized here at its values, where
    pivots had to be raised by orthogonal transformations.  Raises Underconstrained.
    """
    copy = graph.copied()
    values = copy.values.copy()
    # The graph is solved, so all of it is held; and the linearization points are the estimate.  They stay there, in one
    # round, wherever what is left of the gradient leads.
    tree = CliqueTree(copy, Options(mode="bayes-tree", initialize_locally=False, max_rounds=1))
    tree.settings[tl.P_CONVERGED] = np.inf
    if tree.step(sure=True) == tl.FAILED:
        key, factors = int(graph.keys[tree.failed]), graph.factors_of(tree.failed)
        raise errors.Underconstrained(key, factors, "its covariance is infinite; add a prior or a factor")
    copy.values = values
    if tree.raised:
        count, order = int(copy.counts[at.VARIABLES]), np.empty(int(tree.state[tl.S_ALIVE]), np.int64)
        order = order[: list_cliques(tree.node[:count], tree.clique, order)]
        first = np.flatnonzero(is_first(copy.fac[: copy.counts[at.FACTORS]]))
        replace_rows(copy, tree, order, variable_dims(copy.var[:count]), first)
    return _copied(copy, tree)


def variable_dims(var: I64) -> I64:
    """The dimension of the tangent space of every variable in `var`."""
    return DIMS[var[:, at.V_KIND]]


def _copied(graph: FactorGraph, tree: CliqueTree) -> SquareRoot:
    count, state = int(graph.counts[at.VARIABLES]), tree.state
    node, clique = tree.node[:count].copy(), tree.clique[: state[tl.S_CLIQUES]].copy()
    order = np.empty(int(state[tl.S_ALIVE]), np.int64)
    order = order[: list_cliques(node, clique, order)]
    numbers = np.zeros(size_of_rows(order, clique))
    copy_rows(order, clique, tree.numbers, numbers)
    scalar = np.ascontiguousarray(graph.var[:count, at.V_SCALAR])
    rows = CliqueRows(node, clique, tree.lists[: state[tl.S_LISTS]].copy(), numbers)
    return SquareRoot(graph, rows, variable_dims(graph.var[:count]), scalar, order, int(state[tl.S_STAMP]))
