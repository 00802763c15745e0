"""Steps in the modes of the 2013 paper: R is updated, or all of Λ is factorized anew.  MATH §6, §8.

1  place      new variables where their own factors want them
2  check      every new variable is held by something; where only numbers tell, Λ and R are kept as they were
3  extend     what is new is added to Λ and η
4  follow     R and d are updated, or given up
5  solve      Gauss-Newton, if there is anything to solve
6  report     what was done, and where this leaves things
"""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph import observations
from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.graph.factor_rows import losses_of
from factorbus.solver.inc_l.incremental import Incremental, Where
from factorbus.solver.inc_l.strategy import Plan
from factorbus.solver.kernels.graph.local_init import initialize_new
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.kinds import CAMERA, OF_FAMILY
from factorbus.solver.modes import mode_named
from factorbus.solver.optimize.gauss_newton import Minimization, minimize, try_linear_step
from factorbus.solver.optimize.rules import further_rule, ordinary_rule, settling_rule
from factorbus.solver.optimize.system import System
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport, Stopwatch
from factorbus.solver.sparse.anchors import find_unanchored, find_undetermined
from factorbus.solver.sparse.elimination import Elimination
from factorbus.solver.sparse.symbolic import Symbolic
from factorbus.solver.state import State, dump, load
from factorbus.wording import counted

# A step of a robot brings no more variables than this, and some factors each.
_FEW = 8
# The old R is tried while it served in more than _LEAST_TRUST + _TRUST_BY_DENSITY · (factors per variable) of the
# steps that tried lately: a try that fails costs two linearizations, one that does not saves a factorization.
_LEAST_TRUST, _TRUST_BY_DENSITY, _LEARN, _TRY_AGAIN = 0.15, 0.1, 0.1, 16


@dataclass(frozen=True, slots=True)
class _Done:
    """Where the last step left things: what a failed step goes back to.

    unsolved: χ² of the factors added since the system was last solved; infinite if that had not converged.
    converged: as the step reported.  Between forced batches the linear system may be solved, and χ² not at its optimum.
    finished: nothing has moved since another step would have taken no more than a share `FINISHED` off χ².
    batch: variables when the whole system was last solved anew, which the modes with forced batches count from.
    """

    graph: Mark
    fill: tuple[int, int] = (0, 0)
    chi2: float = 0.0
    unsolved: float = 0.0
    damping: float = 0.0
    batch: int = 0
    finished: bool = True
    converged: bool = True


# The types of values in the state of these steps.
STATE_TYPES = (_Done, Symbolic, Where)
VALUE_TYPES = MappingProxyType({kind.__name__: kind for kind in STATE_TYPES})


class IncrementalSteps:
    """Solves for what is new in a graph, step by step.  A `Stepper`."""

    NOT_KEPT = ("_graph", "_options", "_mode", "within")

    def __init__(self, graph: FactorGraph, options: Options) -> None:
        self._graph, self._options = graph, options
        self._mode = mode_named(options.mode)
        self._system = System(graph, Incremental(Elimination(options), options))
        self._changed: I64 = np.empty(0, np.int64)
        self._trust, self._moves = 1.0, 0
        self.within = False
        self._done = _Done(graph.mark())

    @property
    def system(self) -> System:
        """For tests."""
        return self._system

    @property
    def complete(self) -> bool:
        """Every step does all there is to do."""
        return True

    def step(self, settle: bool, budget: float = 0.0, always: bool = False) -> StepReport:
        """As `Solver.step`; there is no budget."""
        return self._step(settle)

    def resume(self, settle: bool) -> StepReport:
        """The first step for a graph that was taken over: it goes on from the estimate, none of which is new."""
        return self._step(settle, resumes=True)

    def changed(self) -> I64:
        """The variables whose values have other bits than before the last step, new ones included."""
        return self._changed

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        return max(self._done.chi2, 0.0)

    @property
    def unfinished(self) -> bool:
        """Whether a step with nothing new may bring the estimate nearer to the optimum by what χ² shows."""
        return not self._done.finished

    @property
    def mark(self) -> Mark:
        """How much of the graph there was after the last step."""
        return self._done.graph

    def restore(self, report: StepReport) -> None:
        """Put the values from before the last step, which gave `report`, back into the graph."""
        if report.strategy != "extend":
            self._system.restore()

    def memory_bytes(self) -> int:
        """Bytes in use for Λ, η and R."""
        return self._system.memory_bytes()

    def _step(self, settle: bool, resumes: bool = False) -> StepReport:
        watch = Stopwatch(self._options.clock)
        try:
            # 1. What is new goes to a good place.
            if self._options.initialize_locally and not resumes:
                self._place_new()
            # 2. Is every new variable held by something?  So far Λ and R are as they were.
            suspects = self._check_new()
            before = dump(self._system) if suspects.size or self._may_rest(resumes) else None
            watch.lap("check")
        except BaseException:
            self._graph.forget(self._done.graph)
            raise
        try:
            # 3. Linearized there it is added to Λ and η.
            added = self._system.blocks.extend(self._graph, self._done.graph)
            suspects = suspects if resumes else self._with_unweighted(suspects)
            watch.lap("linearize")
            # 4. R and d follow.
            plan = self._follow(suspects, watch)
            # 5. Solve, if there is anything to solve.
            because = self._reason_to_solve(added, settle, suspects)
            batch = settle or self._goes_on or self._is_batch_due()
            result, finished = self._solve(added, settle, batch, suspects, watch) if because else self._extend(added)
        except BaseException:
            self._take_back(before)
            raise
        # 6. Remember where this leaves things, and report it.
        report = self._report(result, added, self._reported(plan, because, batch), watch)
        self._commit(result, added, bool(because), batch, finished)
        return report

    def _place_new(self) -> None:
        """Good first values for the few variables that a step of a robot brings."""
        mark, counts = self._done.graph, self._graph.counts.tolist()
        few = counts[at.VARIABLES] - mark[at.VARIABLES] <= _FEW and counts[at.FACTORS] - mark[at.FACTORS] <= 8 * _FEW
        if few and self._mode.updates:
            variables, factors = (mark[at.VARIABLES], counts[at.VARIABLES]), (mark[at.FACTORS], counts[at.FACTORS])
            initialize_new(*variables, *factors, self._options.tuning.chi2_epsilon, self._graph.array_table)

    def _check_new(self) -> I64:
        """New variables that only the numbers can judge.  Raises Underconstrained for what nothing can hold, and
        NotFinite."""
        suspects = find_undetermined(self._graph, self._done.graph)
        if suspects.size:
            free = find_unanchored(self._graph, self._done.graph)
            if free >= 0:
                raise self._system.underconstrained(
                    free,
                    "nothing joins it to a fixed variable or a prior; fix a variable, or add a prior or a factor to "
                    "the rest of the map",
                )
        graph, factors = self._graph, (self._done.graph[at.FACTORS], int(self._graph.counts[at.FACTORS]))
        if not np.isfinite(sum_chi2(*factors, graph.var, graph.fac, graph.values, graph.payload)):
            raise errors.NotFinite("χ² of the new factors")
        return suspects

    def _may_rest(self, resumes: bool) -> bool:
        """Whether all that is on a new variable may have no weight: an observation without a pixel, or by its loss."""
        if resumes or self._graph.counts[at.VARIABLES] == self._done.graph[at.VARIABLES]:
            return False
        fac = self._graph.fac[self._done.graph[at.FACTORS] : self._graph.counts[at.FACTORS]]
        kinds = fac[:, at.F_KIND]
        return bool((CAMERA[kinds] | OF_FAMILY[kinds] | (losses_of(fac) != at.NO_LOSS)).any())

    def _with_unweighted(self, suspects: I64) -> I64:
        """A loss may have set aside all that is on a variable: one that is new is refused then, an old one rests."""
        new = np.arange(self._done.graph[at.VARIABLES], int(self._graph.counts[at.VARIABLES]))
        free = new[self._graph.var[new, at.V_COLUMN] >= 0]
        return np.union1d(suspects, self._system.blocks.unweighted(self._graph, free))

    def _reason_to_solve(self, added: float, settle: bool, suspects: I64) -> str:
        """Why the system is to be solved; empty: there is nothing to solve."""
        if not self._graph.counts[at.COLUMNS]:
            return ""
        if settle:
            return "asked to settle"
        if suspects.size:
            return f"only several factors together hold {counted(suspects.size, 'new variable')}"
        if not np.isfinite(self._done.unsolved):
            return "the last step had not converged"
        if self._goes_on:
            return "nothing is new: to the optimum"
        if self._system.drifted and self._is_batch_due():
            return "a batch is due"
        if self._done.unsolved + added > self._options.tuning.chi2_epsilon:
            return f"new factors add {added:.3g} to χ²"
        return ""

    @property
    def _goes_on(self) -> bool:
        """Nothing is staged, and there is still something to gain."""
        return not self._done.finished and self._graph.mark() == self._done.graph

    def _is_batch_due(self) -> bool:
        every = self._mode.batch_every
        return every > 0 and int(self._graph.counts[at.VARIABLES]) - self._done.batch >= every

    def _follow(self, suspects: I64, watch: Stopwatch) -> Plan:
        """R and d follow Λ and η, or are given up."""
        if not self._mode.updates:
            self._system.factor.moved()
            return Plan("all-batch", "the mode is all-batch")
        if suspects.size:
            self._system.factor.moved()
            return Plan("full", "only the numbers of Λ can tell whether all new variables are held")
        if self._system.rounded:
            self._system.factor.moved()
            return Plan("full", "R is rounding where factors are stiff, and steps go by the factors")
        return self._system.factor.apply(self._graph, self._system.blocks, self._done.graph, watch)

    def _solve(
        self, added: float, settle: bool, batch: bool, suspects: I64, watch: Stopwatch
    ) -> tuple[Minimization, bool]:
        """Gauss-Newton from the present values, or between forced batches one linear step; and whether that is the
        optimum to what χ² shows."""
        system, options, chi2 = self._system, self._options, self._done.chi2 + added
        tolerance = options.incremental_tolerance if self._mode.updates else options.batch_tolerance
        rule, goes_on = ordinary_rule(options, tolerance), self._goes_on and not settle
        if settle:
            rule = settling_rule(options)
        elif goes_on:
            rule = further_rule(options, tolerance)
        system.begin(suspects, watch)
        system.within = self.within
        result = None
        if self._mode.batch_every and not batch:
            result = try_linear_step(system, chi2, rule)
            if result is not None and result.iterations == 0:
                result.converged = self._done.converged
        if result is None:
            if self._mode.batch_every:
                system.relinearize()
            have_factor = self._done.damping == 0.0 and not goes_on and system.serve()
            result = minimize(system, chi2, self._done.damping, rule, have_factor)
            if not (self._mode.updates and result.converged and self._keeps(have_factor, result)):
                system.have_lambda()
        failed = system.variable_of(result.failed) if result.failed >= 0 else -1
        if failed >= self._done.graph[at.VARIABLES] and result.iterations == 0:
            raise system.underconstrained(failed)
        self._changed = system.end(self._done.graph[at.VARIABLES])
        finished = result.converged and (settle or goes_on)
        if goes_on:
            result.converged |= ordinary_rule(options, tolerance).is_negligible(result.left, result.chi2)
        return result, finished

    def _keeps(self, had_factor: bool, result: Minimization) -> bool:
        """Whether R is to stay in use at the new linearization point.

        It is where that has led to the new optimum often enough lately; else every `_TRY_AGAIN`-th of the steps that
        move tries, to find out.
        """
        if not self._options.tuning.reuse_factor:
            return False
        if result.iterations == 0:
            return True
        if had_factor:
            self._trust += (0.0 if result.factorizations else _LEARN) - _LEARN * self._trust
        self._moves += 1
        factors, variables = int(self._graph.counts[at.FACTORS]), int(self._graph.counts[at.VARIABLES])
        least_trust = _LEAST_TRUST + _TRUST_BY_DENSITY * factors / variables
        return self._trust > least_trust or self._moves % _TRY_AGAIN == 0

    def _extend(self, added: float) -> tuple[Minimization, bool]:
        """Nothing moves: what is new has the values it was given or composed to."""
        self._changed = np.arange(self._done.graph[at.VARIABLES], int(self._graph.counts[at.VARIABLES]))
        result = Minimization(self._done.chi2 + added, damping=0.0, converged=self._done.converged)
        return result, self._done.finished

    def _take_back(self, before: State | None) -> None:
        """What came since the last step was never there; before: the system then, where it was kept."""
        self._graph.forget(self._done.graph)
        self._system.take_back(self._done.fill)
        if before is not None:
            load(self._system, before, VALUE_TYPES)

    def _commit(self, result: Minimization, added: float, solved: bool, batch: bool, finished: bool) -> None:
        unsolved = self._done.unsolved + added
        if solved:
            unsolved = 0.0 if result.converged or result.linear else np.inf
        blocks, numbers = self._system.blocks.fill.tolist()
        self._graph.own_before = None
        self._done = _Done(
            self._graph.mark(),
            (blocks, numbers),
            result.chi2,
            unsolved,
            0.0 if result.converged else result.damping,
            int(self._graph.counts[at.VARIABLES]) if batch else self._done.batch,
            finished,
            result.converged,
        )

    def _reported(self, plan: Plan, because: str, batch: bool) -> Plan:
        """What the step is called in the report, and why it was done so."""
        if not because:
            return Plan("extend", "new factors agree with the estimate: the gradient is zero", plan.rows)
        if batch and self._mode.batch_every:
            return Plan("full", f"{because}; a batch is due", plan.rows)
        return Plan(plan.strategy, f"{because}; {plan.because}", plan.rows)

    def _report(self, result: Minimization, added: float, plan: Plan, watch: Stopwatch) -> StepReport:
        columns, factor = int(self._graph.counts[at.COLUMNS]), self._system.factor
        nonzeros, flops = factor.cost() if plan.strategy != "extend" else (0, 0.0)
        return StepReport(
            mode=self._mode.name,
            strategy=plan.strategy,
            because=plan.because,
            iterations=result.iterations,
            chi2=max(result.chi2, 0.0),
            chi2_before=self._done.chi2 + added,
            new_variables=int(self._graph.counts[at.VARIABLES]) - self._done.graph[at.VARIABLES],
            new_factors=self._graph.factor_count - self._done.graph[at.FACTORS] + self._done.graph[at.MEMBERS],
            changed=int(self._changed.size),
            relinearized=result.iterations * columns,
            eliminated=plan.rows + result.factorizations * columns,
            inactive=len(observations.inactive(self._graph)) if self._graph.has_observations else 0,
            nnz_r=nonzeros,
            flops=flops,
            damping=result.damping,
            converged=result.converged,
            phases_ms=watch.phases_ms,
            step_ms=watch.total_ms(),
        )
