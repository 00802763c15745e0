"""What tests look up in a solver beyond what it promises: the one place that knows where that is."""

import numpy as np

from factorbus.solver import Solver
from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.inc_l.incremental import Incremental
from factorbus.solver.inc_l.steps import IncrementalSteps
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.optimize.system import System
from factorbus.solver.stepper import Stepper


def graph_in(solver: Solver) -> FactorGraph:
    """The factor graph of a solver."""
    return solver._graph


def row_count(solver: Solver) -> int:
    """Rows of its factors; those of more than two variables have several."""
    return int(solver._graph.counts[at.FACTORS])


def stepper_in(solver: Solver) -> Stepper:
    """What makes its steps."""
    return solver._stepper


def system_in(solver: Solver) -> System[Incremental]:
    """The normal equations of a solver that has not the mode "bayes-tree", with their factor."""
    stepper = stepper_in(solver)
    assert isinstance(stepper, IncrementalSteps)
    return stepper.system


def tree_of(solver: Solver) -> CliqueTree:
    """The tree of a solver in the mode "bayes-tree"."""
    stepper = stepper_in(solver)
    assert isinstance(stepper, TreeSteps)
    return stepper.tree


def has_nothing_new(solver: Solver) -> bool:
    """Whether nothing was staged since its last step, so that the next one is a further step."""
    return graph_in(solver).mark() == stepper_in(solver).mark


def keys_in(solver: Solver) -> list[int]:
    """The keys of its variables, in the order of their insertion, which is that of their indices."""
    return graph_in(solver).keys[: solver.variable_count].tolist()


def kinds_in(solver: Solver) -> list[str]:
    """The kinds of its variables, likewise."""
    codes = graph_in(solver).var[: solver.variable_count, at.V_KIND]
    return [VARIABLE_KIND_OF_CODE[code].name for code in codes.tolist()]


def fixed_in(solver: Solver) -> list[bool]:
    """Whether its variables are fixed, likewise."""
    return (graph_in(solver).var[: solver.variable_count, at.V_COLUMN] < 0).tolist()


def linearization_points(solver: Solver) -> list[np.ndarray]:
    """Where R is linearized in its variables, likewise: in the mode "bayes-tree" by the tree, else the estimate."""
    graph = graph_in(solver)
    values = tree_of(solver).lin[0] if isinstance(stepper_in(solver), TreeSteps) else graph.values
    rows = graph.var[: solver.variable_count, [at.V_KIND, at.V_AT]].tolist()
    return [values[first : first + VARIABLE_KIND_OF_CODE[code].size].copy() for code, first in rows]


def joined_by(solver: Solver) -> list[list[int]]:
    """The keys of each linear factor of more than two variables, in the order of their ids."""
    graph = graph_in(solver)
    fac = graph.fac[: graph.counts[at.FACTORS]]
    ends = [graph.ends_of(row) for row in np.flatnonzero(fac[:, at.F_KIND] == at.LINEAR).tolist()]
    return [graph.keys[of].tolist() for of in ends if len(of) > 2]


# Nothing is relinearized, so linearization errors are large.
NEVER_RELINEARIZES: dict[str, float] = {
    "relinearize_next_step_share": 1e9,
    "relinearize_same_step_share": 1e9,
    "relinearize_max_error": 1e9,
    "relinearize_max_wait": 10**9,
    "converged_share": 1e9,
}
