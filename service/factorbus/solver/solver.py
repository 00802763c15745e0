"""The solver of one map: batches of variables and factors in, the least-squares estimate out, step by step."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver import errors
from factorbus.solver.admission import admit
from factorbus.solver.anchors import find_unanchored, find_unheld
from factorbus.solver.gauss_newton import Course, Rule, minimise
from factorbus.solver.graph import Graph, Mark
from factorbus.solver.groups import BatchLike, FactorGroup, Group
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import I64
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport, Stopwatch
from factorbus.solver.system import System


@dataclass(frozen=True, slots=True)
class _Done:
    """Where the last step left things: what a failed step goes back to.

    unsolved: χ² of the factors taken in since the system was last solved; infinite if that had not converged.
    """

    graph: Mark
    fill: tuple[int, int] = (0, 0)
    chi2: float = 0.0
    unsolved: float = 0.0
    damping: float = 0.0


class Solver:
    """Variables, factors and their estimate.  Not thread-safe: one thread owns it."""

    def __init__(self, options: Options | None = None) -> None:
        self._options = options or Options()
        self._graph = Graph()
        self._system = System(self._graph, self._options.last_pose_last)
        self._changed: I64 = np.empty(0, np.int64)
        self._done = _Done(self._graph.mark())

    @property
    def variable_count(self) -> int:
        """Variables, the staged ones included."""
        return int(self._graph.counts[at.VARIABLES])

    @property
    def factor_count(self) -> int:
        """Factors, the staged ones included."""
        return int(self._graph.counts[at.FACTORS])

    def stage(self, batch: BatchLike) -> int:
        """Check `batch`, take it in, and give values to its variables that have none; gives the id of its first factor.

        The next step solves for it.  Raises the errors of `admission.admit`; nothing has changed then.
        """
        mark = self._graph.mark()
        try:
            admit(self._graph, batch)
        except BaseException:
            self._graph.forget(mark)
            raise
        return mark[at.FACTORS]

    def step(self, settle: bool = False) -> StepReport:
        """Solve for all that was staged since the last step; with `settle`, until it has converged.

        Raises Underconstrained or NotFinite; what was staged since the last step is taken back then, and the solver is
        as it was after that step, bit for bit.
        """
        watch = Stopwatch(self._options.clock)
        try:
            # 1. Linearise what is new and add it to Λ and η.
            added = self._system.blocks.extend(self._graph, self._done.graph)
            watch.lap("linearise")
            # 2. Is every new variable held by something?
            suspects = self._suspects()
            watch.lap("check")
            # 3. Solve, if there is anything to solve.
            because = self._reason_to_solve(added, settle, suspects)
            course = self._solve(added, settle, suspects, watch) if because else self._extend(added)
        except BaseException:
            self._take_back()
            raise
        # 4. Remember where this leaves things, and account for it.
        report = self._report(course, added, because, watch)
        self._commit(course, added, solved=bool(because))
        return report

    def estimate(self) -> list[Group]:
        """A copy of all values: per kind, in insertion order, fixed variables in groups of their own."""
        return self._graph.variables()

    def changed(self) -> list[Group]:
        """The variables whose values have other bits than before the last step, new ones included, in the same form."""
        return self._graph.variables(self._changed)

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        return self._done.chi2

    def graph(self) -> tuple[list[Group], list[FactorGroup]]:
        """A copy of everything: variables with their present values, and factors by kind in the order of their ids."""
        return self._graph.variables(), self._graph.factors()

    def _suspects(self) -> I64:
        """New variables that only the numbers can judge.  Raises Underconstrained for what nothing can hold."""
        suspects = find_unheld(self._graph, self._done.graph)
        if suspects.size:
            free = find_unanchored(self._graph, self._done.graph)
            if free >= 0:
                raise self._system.underconstrained(
                    free,
                    "nothing joins it to a fixed variable or a prior; fix a variable, or add a prior or a factor to "
                    "the rest of the map",
                )
        return suspects

    def _reason_to_solve(self, added: float, settle: bool, suspects: I64) -> str:
        """Why the system is to be solved; empty: there is nothing to solve."""
        if not np.isfinite(added):
            raise errors.NotFinite("χ² of the new factors")
        if not self._graph.counts[at.COLUMNS]:
            return ""
        if settle:
            return "asked to settle"
        if suspects.size:
            return f"{suspects.size} new variables are held only by several factors together"
        if not np.isfinite(self._done.unsolved):
            return "the last step had not converged"
        if self._done.unsolved + added > self._options.negligible:
            return f"new factors add {added:.3g} to χ²"
        return ""

    def _solve(self, added: float, settle: bool, suspects: I64, watch: Stopwatch) -> Course:
        """Gauss-Newton from the present values."""
        options = self._options
        rule = Rule(options.tolerance, options.negligible, options.max_iterations)
        if settle:
            rule = Rule(options.settle_tolerance, 1e-8 * options.negligible, options.settle_iterations)
        self._system.begin(suspects, watch)
        course = minimise(self._system, self._done.chi2 + added, self._done.damping, rule)
        if course.failed >= 0 and course.iterations == 0:
            raise self._system.underconstrained(self._system.variable_of(course.failed))
        self._changed = self._system.end(self._done.graph[at.VARIABLES])
        return course

    def _extend(self, added: float) -> Course:
        """Nothing moves: what is new has the values it was given or composed to."""
        self._changed = np.arange(self._done.graph[at.VARIABLES], self.variable_count)
        return Course(self._done.chi2 + added, damping=0.0, converged=True)

    def _take_back(self) -> None:
        self._graph.forget(self._done.graph)
        self._system.take_back(self._done.fill)

    def _commit(self, course: Course, added: float, solved: bool) -> None:
        unsolved = self._done.unsolved + added
        if solved:
            unsolved = 0.0 if course.converged else np.inf
        blocks, numbers = self._system.blocks.fill.tolist()
        self._done = _Done(
            self._graph.mark(), (blocks, numbers), course.chi2, unsolved, 0.0 if course.converged else course.damping
        )

    def _report(self, course: Course, added: float, because: str, watch: Stopwatch) -> StepReport:
        columns = int(self._graph.counts[at.COLUMNS])
        symbolic = self._system.elimination.symbolic if because else None
        return StepReport(
            mode="all-batch",
            strategy="all-batch" if because else "extend",
            because=because or "new factors agree with the estimate: the gradient is zero",
            iterations=course.iterations,
            chi2=course.chi2,
            chi2_before=self._done.chi2 + added,
            new_variables=self.variable_count - self._done.graph[at.VARIABLES],
            new_factors=self.factor_count - self._done.graph[at.FACTORS],
            changed=int(self._changed.size),
            relinearised=course.iterations * columns,
            eliminated=course.factorisations * columns,
            nnz_r=symbolic.nnz_r if symbolic else 0,
            flops=symbolic.flops if symbolic else 0.0,
            damping=course.damping,
            converged=course.converged,
            phases_ms=watch.phases_ms,
            step_ms=watch.total_ms(),
        )
