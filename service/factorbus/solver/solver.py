"""The solver of one map: batches of variables and factors in, the least-squares estimate out, step by step."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.changes.edited import edited
from factorbus.solver.changes.requested import unchanged
from factorbus.solver.covariance.source import CovarianceSource
from factorbus.solver.errors import BadOption
from factorbus.solver.graph import observations
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.columns import Columns
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import BatchLike, FactorGroup, Group
from factorbus.solver.graph.own_kinds import check_new_kinds
from factorbus.solver.inc_l.steps import VALUE_TYPES, IncrementalSteps
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.sparse.fronts import LANES
from factorbus.solver.modes import mode_named
from factorbus.solver.option_ranges import check_number
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport
from factorbus.solver.sparse.cholmod import require_cholmod
from factorbus.solver.state import State, dump, load
from factorbus.solver.stepper import Stepper

_LANES = "lanes"


class Solver:
    """Variables, factors and their estimate.  Not thread-safe: one thread owns it.

    covariances     R of the last step, for covariances: `CovarianceSource`
    """

    NOT_KEPT = ("_options", "covariances")

    def __init__(self, options: Options | None = None) -> None:
        self._options = Options() if options is None else options
        if not isinstance(self._options, Options):
            raise BadOption("options", repr(self._options)[:80], "an Options, or None for the defaults")
        if self._options.backend == "cholmod":
            require_cholmod()
        self._graph = FactorGraph()
        steps = TreeSteps if mode_named(self._options.mode).tree else IncrementalSteps
        self._stepper: Stepper = steps(self._graph, self._options)
        self.covariances = CovarianceSource(self._graph, self._stepper)

    @property
    def variable_count(self) -> int:
        """Variables, the staged ones included."""
        return int(self._graph.counts[at.VARIABLES])

    @property
    def factor_count(self) -> int:
        """Factors, the staged ones included."""
        return self._graph.factor_count

    def check_new_kinds(self, batch: BatchLike) -> None:
        """Raises TooLarge: to compile the own kinds that are new in `batch` takes longer than a step may."""
        check_new_kinds(self._graph, batch)

    def stage(self, batch: BatchLike | Columns) -> int:
        """Check `batch`, take it in, and give values to its variables that have none; gives the id of its first factor.

        The next step solves for it.  Raises the errors of `admission.admit`; nothing has changed then.
        """
        return admit(self._graph, batch)

    def step(self, settle: bool = False, budget: float | None = None) -> StepReport:
        """Solve for all that was staged since the last step; with `settle`, until it has converged.

        budget: in the place of `Options.step_budget`, for this step, and of its range; also where nothing is staged.
            With a budget a step may raise χ² by up to `Options.converged_share` of it.

        Raises BadOption; or Underconstrained or NotFinite, and what was staged since the last step is taken back then,
        and the solver is as it was after that step, bit for bit.
        """
        if budget is None:
            return self._stepper.step(settle, self._options.step_budget)
        check_number("step_budget", budget)
        return self._stepper.step(settle, budget, always=True)

    @contextmanager
    def within_bounds(self) -> Iterator[None]:
        """While inside, steps go no further than the bounds of numbers let them.  MATH §2.5."""
        self._stepper.within = True
        try:
            yield
        finally:
            self._stepper.within = False

    def estimate(self) -> list[Group]:
        """A copy of all values: per kind, in insertion order, fixed variables in groups of their own.

        What never changes, keys and the values of fixed variables, is read-only: estimates may have it in common.
        """
        return self._graph.variables()

    def changed(self) -> list[Group]:
        """The variables whose values have other bits than before the last step, new ones included, in the same form."""
        return self._graph.variables(self._stepper.changed())

    def pick_changed(self) -> tuple[I64, FactorGraph]:
        """What `changed` lists, as indices of variables, ascending, and the arenas to look them up in, to be read."""
        return self._stepper.changed(), self._graph

    @property
    def factor_graph(self) -> FactorGraph:
        """The graph as it is: to be looked up in, and for `closures` to name factors."""
        return self._graph

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        return self._stepper.chi2()

    @property
    def unfinished(self) -> bool:
        """Whether a step with nothing staged may bring the estimate nearer to the optimum by what χ² shows.

        That is so where a step has not converged, and also by as much as one that has leaves undone.
        """
        return self._stepper.unfinished

    @property
    def complete(self) -> bool:
        """Whether the last step left nothing for later ones, as one with a budget may."""
        return self._stepper.complete

    def renew(self, other: "Solver", variables: int, factors: int) -> StepReport:
        """Take over the first variables and factors of `other`, as they are; the first step of a new solver."""
        edits = unchanged(other._graph)
        edits.stays[variables:] = False
        edits.kept[other._graph.rows_of_first(factors) :] = False
        self._graph.take(edited(other._graph, edits))
        return self._stepper.resume(False)

    def inactive(self) -> list[tuple[int, str, str]]:
        """(factor id, the factor, why) of every observation that has no pixel at the estimate, and so no weight."""
        return observations.inactive(self._graph)

    def memory_bytes(self) -> int:
        """Bytes in use for the graph and for what solves it."""
        return self._graph.memory_bytes() + self._stepper.memory_bytes()

    def graph(self, variables: int | None = None, factors: int | None = None) -> tuple[list[Group], list[FactorGroup]]:
        """A copy of everything: variables with their present values, and factors by kind in the order of their ids.

        variables, factors: how many of each at most, the first ones.
        """
        count = self.variable_count if variables is None else min(variables, self.variable_count)
        rows = None if factors is None else self._graph.rows_of_first(factors)
        return self._graph.variables(np.arange(count)), self._graph.factors(rows)

    def content(self) -> FactorGraph:
        """A copy of everything, as of the last step, for computations elsewhere."""
        return self._graph.copied()

    def dump(self) -> State:
        """All that later steps depend on, as of the last step: `load` it into a solver with the same options.

        That one goes on with the same bits, if it is of the same `build`.  Nothing may be staged.
        """
        return dump(self) | {_LANES: LANES}

    def load(self, state: Mapping[str, Any]) -> StepReport | None:
        """Be where the solver that gave `state` was; None: to the bit.

        Rows of R are as wide as the vectors of a processor.  Where those are others the map is taken over with its
        estimate, and all of it is eliminated anew: the report is of that step.  Raises ValueError, and what `step`
        does, and is of no use then.
        """
        parts = dict(state)
        if parts.pop(_LANES, LANES) == LANES:
            load(self, parts, VALUE_TYPES)
            return None
        load(self._graph, parts["_graph"], VALUE_TYPES)
        return self._stepper.resume(False)
