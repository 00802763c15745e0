"""What tests look up in a solver beyond what it promises: the one place that knows where that is."""

import numpy as np
from naive.tree_records import tree_of

from factorbus.solver import Solver
from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.inc_l.incremental import Incremental
from factorbus.solver.inc_l.steps import IncrementalSteps
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.optimize.system import System


def graph_in(solver: Solver) -> FactorGraph:
    """The factor graph of a solver."""
    return solver._graph


def row_count(solver: Solver) -> int:
    """Rows of its factors; those of more than two variables have several."""
    return int(solver._graph.counts[at.FACTORS])


def system_in(solver: Solver) -> System[Incremental]:
    """The normal equations of a solver that has not the mode "bayes-tree", with their factor."""
    assert isinstance(solver._stepper, IncrementalSteps)
    return solver._stepper.system


def keys_in(solver: Solver) -> list[int]:
    """The keys of its variables, in the order of their insertion, which is that of their indices."""
    return solver._graph.keys[: solver.variable_count].tolist()


def kinds_in(solver: Solver) -> list[str]:
    """The kinds of its variables, likewise."""
    return [VARIABLE_KIND_OF_CODE[code].name for code in solver._graph.var[: solver.variable_count, at.V_KIND].tolist()]


def fixed_in(solver: Solver) -> list[bool]:
    """Whether its variables are fixed, likewise."""
    return (solver._graph.var[: solver.variable_count, at.V_COLUMN] < 0).tolist()


def linearization_points(solver: Solver) -> list[np.ndarray]:
    """Where R is linearized in its variables, likewise: in the mode "bayes-tree" by the tree, else the estimate."""
    graph = solver._graph
    values = tree_of(solver).lin[0] if isinstance(solver._stepper, TreeSteps) else graph.values
    rows = graph.var[: solver.variable_count, [at.V_KIND, at.V_AT]].tolist()
    return [values[first : first + VARIABLE_KIND_OF_CODE[code].size].copy() for code, first in rows]
