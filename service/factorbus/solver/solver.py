"""The solver of one map: batches of variables and factors in, the least-squares estimate out, step by step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from factorbus.solver import errors
from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.changes.convert_to_points import find_ripe, is_held, with_points
from factorbus.solver.changes.edited import edited
from factorbus.solver.changes.in_place import try_in_place
from factorbus.solver.changes.requested import ChangeLike, collect, unchanged
from factorbus.solver.covariance.factored import Factored, factored, factored_anew, viewed
from factorbus.solver.covariance.live import Live
from factorbus.solver.covariance.upkeep import Upkeep
from factorbus.solver.graph import observations as sights
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import Graph, Mark
from factorbus.solver.graph.groups import Addition, BatchLike, FactorGroup, Group
from factorbus.solver.graph.joints import check_joints, find_apart
from factorbus.solver.graph.packing import Packing
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.inc_l.incremental import Incremental, Where
from factorbus.solver.inc_l.strategy import Plan
from factorbus.solver.kernels.graph.admit_bytes import admit_bytes
from factorbus.solver.kernels.graph.local_init import settle_new
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.sparse.fronts import LANES
from factorbus.solver.modes import mode_named
from factorbus.solver.optimize.gauss_newton import Course, glide, minimise
from factorbus.solver.optimize.rules import further_rule, ordinary_rule, settling_rule
from factorbus.solver.optimize.system import System
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport, Stopwatch
from factorbus.solver.sparse.anchors import find_unanchored, find_unheld
from factorbus.solver.sparse.elimination import Elimination
from factorbus.solver.sparse.symbolic import Symbolic
from factorbus.solver.state import State, dump, load
from factorbus.wording import counted

# A step of a robot brings no more variables than this, and some factors each.
_FEW = 8
# The old R is tried while it served in more than _LEAST_TRUST + _DEAR · (factors per variable) of the steps that tried
# lately: a try that fails costs two linearisations, one that does not saves a factorisation.
_LEAST_TRUST, _DEAR, _LEARN, _TRY_AGAIN = 0.15, 0.1, 0.1, 16


@dataclass(frozen=True, slots=True)
class _Done:
    """Where the last step left things: what a failed step goes back to.

    unsolved: χ² of the factors taken in since the system was last solved; infinite if that had not converged.
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


_LANES = "lanes"
_VALUES = MappingProxyType({kind.__name__: kind for kind in (_Done, Symbolic, Where)})


class Solver:
    """Variables, factors and their estimate.  Not thread-safe: one thread owns it."""

    NOT_KEPT = ("_options", "_mode", "_live", "_packing")

    def __init__(self, options: Options | None = None) -> None:
        self._options = options or Options()
        self._graph = Graph()
        self._mode = mode_named(self._options.mode)
        self._system = System(self._graph, Incremental(Elimination(self._options), self._options))
        self._tree = TreeSteps(self._graph, self._options) if self._mode.tree else None
        self._live = Live(self._graph, self._tree.tree) if self._tree else None
        self._packing = Packing()
        self._changed: I64 = np.empty(0, np.int64)
        self._trust, self._moves = 1.0, 0
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
        """As `stage`, for a small batch whose columns lie in `raw`; None: nothing was done, `stage` says why.

        groups (n, layout.G_WIDTH): where they lie, as `kernels/model/layout.py` says.  Offsets and sizes are
        the caller's word: they are not checked again.
        """
        first = admit_bytes(raw, groups, self._graph.places)
        if first == at.NO_ROOM:
            self._graph.make_room(groups)
            first = admit_bytes(raw, groups, self._graph.places)
        return None if first < 0 else first + self._graph.id_shift

    def step(self, settle: bool = False) -> StepReport:
        """Solve for all that was staged since the last step; with `settle`, until it has converged.

        Raises Underconstrained or NotFinite; what was staged since the last step is taken back then, and the solver is
        as it was after that step, bit for bit.
        """
        return self._tree.step(settle) if self._tree else self._step(settle, self._options.initialize_locally)

    def _resume(self, settle: bool = False) -> StepReport:
        """The first step of a solver that has taken over a map: it goes on from the estimate, none of which is new."""
        if self._tree is None:
            return self._step(settle, place_new=False)
        with self._tree.tree.placing_none():
            return self._tree.step(settle)

    def _step(self, settle: bool, place_new: bool) -> StepReport:
        """One step of a mode without a tree."""
        watch = Stopwatch(self._options.clock)
        try:
            # 1. What is new goes to a good place; linearised there it is added to Λ and η.
            if place_new:
                self._place_new()
            added = self._system.blocks.extend(self._graph, self._done.graph)
            watch.lap("linearise")
            # 2. Is every new variable held by something?
            suspects = self._suspects()
            watch.lap("check")
            # 3. R and d follow.
            plan = self._follow(suspects, watch)
            # 4. Solve, if there is anything to solve.
            because = self._reason_to_solve(added, settle, suspects)
            batch = settle or self._goes_on or self._is_batch_due()
            course, finished = self._solve(added, settle, batch, suspects, watch) if because else self._extend(added)
        except BaseException:
            self._take_back()
            raise
        # 5. Remember where this leaves things, and account for it.
        report = self._report(course, added, self._told(plan, because, batch), watch)
        self._commit(course, added, bool(because), batch, finished)
        return report

    def estimate(self) -> list[Group]:
        """A copy of all values: per kind, in insertion order, fixed variables in groups of their own.

        What never changes, keys and the values of fixed variables, is read-only: estimates may have it in common.
        """
        return self._graph.variables()

    def changed(self) -> list[Group]:
        """The variables whose values have other bits than before the last step, new ones included, in the same form."""
        return self._graph.variables(self.pick_changed()[0])

    def pick_changed(self) -> tuple[I64, Graph]:
        """What `changed` tells of as indices of variables, ascending, and the arenas to look them up in, to be read."""
        return self._tree.changed() if self._tree else self._changed, self._graph

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        return self._tree.chi2() if self._tree else max(self._done.chi2, 0.0)

    @property
    def unfinished(self) -> bool:
        """Whether a step with nothing staged may bring the estimate nearer to the optimum by what χ² shows.

        That is so where a step has not converged, and also by as much as one that has leaves undone.
        """
        return self._tree.unfinished if self._tree else not self._done.finished

    def ripe(self, below: float) -> I64:
        """Keys of the features whose linearity index is below this: as points they are as good Gaussians.  MATH §3.3"""
        return self._graph.keys[find_ripe(self._graph, below)]

    def with_points(self, keys: I64) -> tuple["Solver", StepReport]:
        """A solver in which these features are points, under their keys, and its first step; this one stays as it is.

        Later sights of them may still be sent as `idp_seen`.  Raises UnknownVariable, KindMismatch, and as `step` does.
        """
        picked = np.array([self._graph.find(key) for key in keys.tolist()], np.int64)
        for key, v in zip(keys.tolist(), picked.tolist(), strict=True):
            if v < 0:
                raise errors.UnknownVariable(key, "turning features into points")
            if (kind := int(self._graph.var[v, at.V_KIND])) != at.IDP:
                raise errors.KindMismatch(key, "turning features into points", VARIABLE_KIND_OF_CODE[kind].name, "idp")
            if is_held(self._graph)[v]:
                seen, wanted = "idp with a linear factor", "idp that cameras see"
                raise errors.KindMismatch(key, "turning features into points", seen, wanted)
        made = Solver(self._options)
        made._graph.take(with_points(self._graph, picked))
        return made, made._resume()

    def with_changes(
        self, changes: Sequence[ChangeLike], batch: BatchLike | None = None, settle: bool = False
    ) -> tuple["Solver", int, StepReport, dict[str, int]]:
        """A solver of the same map with `changes` made, in their order, and then `batch` added; this one stays.

        Gives it, the id of the first factor of `batch`, the report of its first step, and what was changed.  That step
        relinearises everything at the estimate and eliminates all anew, whatever the mode.  Nothing may be staged.
        Raises as `changes.collect`, `stage` and `step` do.
        """
        edits = collect(self._graph, changes)
        made = Solver(self._options)
        made._graph.take(edited(self._graph, edits))
        check_joints(made._graph)
        made._add(edits.added)
        variables, factors = made.variable_count, made.factor_count
        first = made._graph.next_id if batch is None else made.stage(batch)
        new = made.variable_count - variables, made.factor_count - factors
        report = made._resume(settle)._replace(new_variables=new[0], new_factors=new[1])
        return made, first, report, edits.counted

    def try_change(
        self, changes: Sequence[ChangeLike], batch: BatchLike | None = None, settle: bool = False
    ) -> tuple[int, StepReport, dict[str, int]] | None:
        """Make `changes` of factors, add `batch`, and step, in this solver: it eliminates what they touch, no more.

        Gives what `with_changes` gives.  None: only that can make them, or say why not; then nothing has changed.  So
        it is where they remove, fix, free, place or marginalise variables, where linear factors are among them, where
        something would be free to move, with `settle`, and in modes other than "bayes-tree".  Nothing may be staged.
        Raises as `changes.collect` and `stage` do.
        """
        if self._tree is None or settle:
            return None
        edits = collect(self._graph, changes)
        came = try_in_place(
            self._graph, self._tree, edits, lambda: self._graph.next_id if batch is None else self.stage(batch)
        )
        return None if came is None else (*came, edits.counted)

    def renew(self, other: "Solver", variables: int, factors: int) -> StepReport:
        """Take over the first so many variables and factors of `other`, as they are; the first step of a new solver."""
        edits = unchanged(other._graph)
        edits.stays[variables:] = False
        edits.kept[factors:] = False
        self._graph.take(edited(other._graph, edits))
        return self._resume()

    def asleep(self) -> list[tuple[int, str, str]]:
        """(factor id, the factor, why) of every sight that has no pixel at the estimate, and so no weight."""
        return sights.asleep(self._graph)

    def memory_bytes(self) -> int:
        """Bytes in use for the graph and for what solves it."""
        return self._graph.memory_bytes() + (self._tree.tree if self._tree else self._system).memory_bytes()

    def columns_bytes(self) -> tuple[int, int]:
        """Bytes of all variables, and of all factors, as columns."""
        return self._graph.columns_bytes()

    def graph(self, variables: int | None = None, factors: int | None = None) -> tuple[list[Group], list[FactorGroup]]:
        """A copy of everything: variables with their present values, and factors by kind in the order of their ids;
        but those that are one factor in pieces behind the others, in their order.

        variables, factors: no more than the first so many.
        """
        count = self.variable_count if variables is None else min(variables, self.variable_count)
        return self._graph.variables(np.arange(count)), self._graph.factors(factors, find_apart(self._graph))

    def content(self) -> Graph:
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
            load(self, parts, _VALUES)
            return None
        load(self._graph, parts["_graph"], _VALUES)
        return self._resume()

    def factored(self) -> Factored:
        """A copy of R and of all that it is of, as of the last step: what covariances are computed from, elsewhere.

        In the mode "bayes-tree" that is its R, linearised where it is; in the others one made here, at the estimate.
        """
        return factored(self._graph, self._tree.tree) if self._tree else factored_anew(self._graph)

    def factoring(self) -> Callable[[], Factored]:
        """What gives `factored` as of now, on any thread and later: R is copied here, or else what it is made from."""
        if self._tree:
            found = self.factored()
            return lambda: found
        return partial(factored_anew, self._graph.copied())

    def try_view(self) -> Factored | None:
        """The same without a copy, for questions about a few variables: until the next step, on the thread that steps.

        None: this mode keeps no R that could be read in place; `factored` makes one.
        """
        return viewed(self._graph, self._tree.tree) if self._tree else None

    def try_upkeep(self) -> Upkeep | None:
        """What keeps all diagonal blocks of the covariance up, updated after every step.  None: as for `try_view`."""
        return Upkeep(self._graph, self._tree.tree) if self._tree else None

    def try_joint(self, variables: I64) -> F64 | None:
        """The joint covariance of a few different free variables (by index) as of the last step, read from R in place.

        None: as for `try_view`.
        """
        return self._live.joint(variables) if self._live else None

    def _add(self, factors: Sequence[FactorGroup]) -> None:
        if factors:
            admit(self._graph, Addition((), factors))

    def _place_new(self) -> None:
        """Good first values for the few variables that a step of a robot brings."""
        mark, counts = self._done.graph, self._graph.counts.tolist()
        few = counts[at.VARIABLES] - mark[at.VARIABLES] <= _FEW and counts[at.FACTORS] - mark[at.FACTORS] <= 8 * _FEW
        if few and self._mode.updates:
            epsilon = self._options.tuning.chi2_epsilon
            graph = self._graph
            settle_new(
                mark[at.VARIABLES], counts[at.VARIABLES], mark[at.FACTORS], counts[at.FACTORS], epsilon,
                graph.var, graph.fac, graph.values, graph.payload,
            )  # fmt: skip

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
        return every > 0 and self.variable_count - self._done.batch >= every

    def _follow(self, suspects: I64, watch: Stopwatch) -> Plan:
        """R and d follow Λ and η, or are given up."""
        if not self._mode.updates:
            self._system.factor.moved()
            return Plan("all-batch", "the mode is all-batch")
        if suspects.size:
            self._system.factor.moved()
            return Plan("full", "only the numbers of Λ can tell whether all new variables are held")
        return self._system.factor.fold(self._graph, self._system.blocks, self._done.graph, watch)

    def _solve(self, added: float, settle: bool, batch: bool, suspects: I64, watch: Stopwatch) -> tuple[Course, bool]:
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
        course = None
        if self._mode.batch_every and not batch:
            course = glide(system, chi2, rule)
        if course is None:
            if self._mode.batch_every:
                system.relinearise()
            have_factor = self._done.damping == 0.0 and not goes_on and system.factor.serve()
            course = minimise(system, chi2, self._done.damping, rule, have_factor)
            if not (self._mode.updates and course.converged and self._keeps(have_factor, course)):
                system.have_lambda()
        if course.failed >= 0 and course.iterations == 0:
            raise system.underconstrained(system.variable_of(course.failed))
        self._changed = system.end(self._done.graph[at.VARIABLES])
        finished = course.converged and (settle or goes_on)
        if goes_on:
            course.converged |= ordinary_rule(options, tolerance).is_negligible(course.left, course.chi2)
        return course, finished

    def _keeps(self, had_factor: bool, course: Course) -> bool:
        """Whether R is to stay in use at the new linearisation point.

        It is where that has led to the new optimum often enough lately; else every `_TRY_AGAIN`-th of the steps that
        move tries, to find out.
        """
        if not self._options.tuning.reuse_factor:
            return False
        if course.iterations == 0:
            return True
        if had_factor:
            self._trust += (0.0 if course.factorisations else _LEARN) - _LEARN * self._trust
        self._moves += 1
        dear = _LEAST_TRUST + _DEAR * self.factor_count / self.variable_count
        return self._trust > dear or self._moves % _TRY_AGAIN == 0

    def _extend(self, added: float) -> tuple[Course, bool]:
        """Nothing moves: what is new has the values it was given or composed to."""
        self._changed = np.arange(self._done.graph[at.VARIABLES], self.variable_count)
        return Course(self._done.chi2 + added, damping=0.0, converged=True), self._done.finished

    def _take_back(self) -> None:
        self._graph.forget(self._done.graph)
        self._system.take_back(self._done.fill)

    def _commit(self, course: Course, added: float, solved: bool, batch: bool, finished: bool) -> None:
        unsolved = self._done.unsolved + added
        if solved:
            unsolved = 0.0 if course.converged else np.inf
        blocks, numbers = self._system.blocks.fill.tolist()
        self._done = _Done(
            self._graph.mark(),
            (blocks, numbers),
            course.chi2,
            unsolved,
            0.0 if course.converged else course.damping,
            self.variable_count if batch else self._done.batch,
            finished,
        )

    def _told(self, plan: Plan, because: str, batch: bool) -> Plan:
        """What the step is called in the report, and why it was done so."""
        if not because:
            return Plan("extend", "new factors agree with the estimate: the gradient is zero", plan.rows)
        if batch and self._mode.batch_every:
            return Plan("full", f"{because}; a batch is due", plan.rows)
        return Plan(plan.strategy, f"{because}; {plan.because}", plan.rows)

    def _report(self, course: Course, added: float, plan: Plan, watch: Stopwatch) -> StepReport:
        columns, factor = int(self._graph.counts[at.COLUMNS]), self._system.factor
        nonzeros, flops = factor.cost() if plan.strategy != "extend" else (0, 0.0)
        return StepReport(
            mode=self._mode.name,
            strategy=plan.strategy,
            because=plan.because,
            iterations=course.iterations,
            chi2=max(course.chi2, 0.0),
            chi2_before=self._done.chi2 + added,
            new_variables=self.variable_count - self._done.graph[at.VARIABLES],
            new_factors=self.factor_count - self._done.graph[at.FACTORS],
            changed=int(self._changed.size),
            relinearised=course.iterations * columns,
            eliminated=plan.rows + course.factorisations * columns,
            asleep=len(sights.asleep(self._graph)) if self._graph.sights else 0,
            nnz_r=nonzeros,
            flops=flops,
            damping=course.damping,
            converged=course.converged,
            phases_ms=watch.phases_ms,
            step_ms=watch.total_ms(),
        )
