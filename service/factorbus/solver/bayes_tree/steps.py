"""Steps in the mode "bayes-tree": the tree of cliques does the work, and Levenberg-Marquardt on all of Λ is behind it.

A step solves a linear problem, measures χ² at the estimate that it comes to, and relinearizes what is too far from its
linear model (MATH §9.6).  One that raises χ² is replaced by Levenberg-Marquardt from where the estimate stood.
"""

import copy
import math
from dataclasses import replace

import numpy as np

from factorbus.solver import errors
from factorbus.solver.bayes_tree.left_to_gain import AT_END, is_left, judge_batch
from factorbus.solver.bayes_tree.reasons import why_batch, why_tree
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.bayes_tree.undetermined import check_determined
from factorbus.solver.graph.escaped import find_beyond
from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.inc_l.incremental import Incremental
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.convergence import FINISHED, unsolved
from factorbus.solver.kernels.bayes_tree.defer import MOST_RISE
from factorbus.solver.kernels.bayes_tree.thresholds import LEAST_CHI2
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.retract import differing
from factorbus.solver.optimize.gauss_newton import Minimization, minimize
from factorbus.solver.optimize.rules import further_rule, ordinary_rule, settling_rule
from factorbus.solver.optimize.system import System
from factorbus.solver.option_ranges import MOST_BUDGET
from factorbus.solver.options import Options
from factorbus.solver.report import PhaseShares, StepReport, Stopwatch
from factorbus.solver.sparse.elimination import Elimination

_START: Mark = (0,) * at.COUNTS
_ROUNDING, _LEAST_GAIN = 1e-12, 1e-15
_COUNTS, _PHASES = slice(tl.S_REPORT_BEGIN, tl.S_CYCLES), slice(tl.S_CYCLES, tl.S_REPORT_END)
# What back-substitution left undone, below which there is no need to go on, as a share of χ²: by the bound (9.17), some
# hundred times what it comes to.
_FINISHED_LEFT = 1e-7
# Of χ²: a step with nothing new that gains less with damping takes the wrong way.
_HARDLY = 1e-4
_NO_BUDGET = (0, 0.0, 0.0, 0.0, True)
_NO_SHARES = PhaseShares(tl.PHASES, [0] * len(tl.PHASES), 0.0)
_new = tuple.__new__


class TreeSteps:
    """Solves for what is new in a graph, step by step."""

    NOT_KEPT = ("_graph", "_options", "_resumes", "before_batch", "within")

    def __init__(self, graph: FactorGraph, options: Options) -> None:
        self._graph, self._options = graph, options
        self._tree = CliqueTree(graph, options)
        self._mark, self.within, self._resumes = graph.mark(), False, False
        self._first_new, self._batched, self._at_linearization = 0, False, False
        self._damping = 0.0  # with which a batch ended that had not converged: the next one goes on from it
        self._moved: I64 = np.empty(0, np.int64)  # by a batch
        self.before_batch: F64 = np.empty(0)  # the values before the last step that was a batch

    @property
    def tree(self) -> CliqueTree:
        """The clique tree, for covariances and for changes in place."""
        return self._tree

    @property
    def mark(self) -> Mark:
        """How much of the graph there was after the last step."""
        return self._mark

    def step(self, settle: bool, budget: float = 0.0, always: bool = False) -> StepReport:
        """As `Solver.step`.  always: the budget is one of a step with nothing new, too."""
        clock = self._options.clock
        started = clock() if clock else 0.0
        tree, because = self._tree, ""
        bounded = not settle and 0.0 < budget <= MOST_BUDGET and (always or self._has_new)
        # What takes over a graph has it all in hands, and what was found to be left is looked for until it is not.
        looks = not bounded and (self._resumes or tree.totals.item(tl.T_EXCESS) > 0.0)
        if bounded:
            tree.set_budget(budget)
        try:
            status = tree.step()
            if status == tl.UNSURE:
                because = check_determined(self._graph, self._mark, lambda: self._system(self._apart()))
                status = tree.step(sure=True)
            if status == tl.FAILED:
                raise self._system(self._apart()).underconstrained(tree.failed)
            if status == tl.INFINITE:
                raise errors.NotFinite("χ² of the new factors")
        except BaseException:
            self._graph.forget(self._mark)
            raise
        finally:
            if bounded:
                tree.set_budget(math.inf)
        compiled = clock() if clock else 0.0
        self._at_linearization = False
        if status == tl.CLEAR and not (looks or settle or self.within):
            self._damping = 0.0
            return self._report(started, compiled, None, because, budget if bounded else 0.0, clear=True)
        if not bounded:
            self._look_again(looks)
        escaped = self._has_escaped
        stands = not tree.state.item(tl.S_AFTER) and (bounded or not (self._is_open or self._stalls))
        if not settle and not escaped and (stands or (bounded and self._is_tolerable)):
            self._damping = 0.0
            return self._report(started, compiled, None, because, budget if bounded else 0.0, clear=False)
        result, because = self._complete(settle and bool(self._graph.counts[at.COLUMNS]), because, escaped, bounded)
        return self._report(started, compiled, result, because, budget if bounded else 0.0, clear=False)

    def resume(self, settle: bool) -> StepReport:
        """The first step for a graph that was taken over: it goes on from the estimate, none of which is new."""
        with self._tree.placing_none():
            self._resumes = True
            try:
                return self.step(settle)
            finally:
                self._resumes = False

    def restore(self, report: StepReport) -> None:
        """Put the values from before the last step, which gave `report`, back into the graph."""
        if report.strategy != "batch":
            self._tree.exchange()
            return
        used = int(self._graph.counts[at.VALUES])
        self._graph.values[:used] = self.before_batch[:used]

    def memory_bytes(self) -> int:
        """Bytes in use for the tree."""
        return self._tree.memory_bytes()

    def rebase(self, rows: int, members: int) -> None:
        """Note how many rows of factors are gone since the last step, and how many of them are members."""
        mark = list(self._mark)
        mark[at.FACTORS] -= rows
        mark[at.MEMBERS] -= members
        self._mark = tuple(mark)

    def forget(self) -> None:
        """What came since the last step was never there."""
        self._graph.forget(self._mark)

    def start_over(self) -> None:
        """A new tree for the graph as it is, which leaves the estimate where it is."""
        self._begin_anew(self._graph.values)

    def changed(self) -> I64:
        """The variables whose values have other bits than before the last step, new ones included."""
        if self._batched:
            return self._moved
        return self._tree.list_changed(self._first_new)

    @property
    def unfinished(self) -> bool:
        """Whether a step with nothing new may bring the estimate nearer to the optimum by what χ² shows, (9.27)."""
        _, chi2, _, error, _, _, _, left, *_ = self._tree.totals.tolist()
        share = max(chi2, 0.0) + LEAST_CHI2
        scalars = int(self._graph.counts[at.SCALARS])
        if self._tree.behind:
            return True
        if self._at_linearization or self._tree.raised:
            return not self._is_within(AT_END, chi2)
        open_still = self._tree.totals.item(tl.T_EXCESS) > 0.0
        return open_still or error > FINISHED * share or left * scalars > _FINISHED_LEFT * share

    @property
    def complete(self) -> bool:
        """Whether the last step left nothing for later ones."""
        return not (self._tree.deferred or self._tree.behind)

    @property
    def _has_new(self) -> bool:
        """Whether anything came or was edited since the last step."""
        return self._graph.mark() != self._mark or self._tree.state.item(tl.S_EDITED) != 0

    @property
    def _stalls(self) -> bool:
        """Whether the tree's last step, with nothing new, raised χ², or left more to do and lowered it by less."""
        if not self._tree.state.item(tl.S_CONTINUES):
            return False
        least = FINISHED * self._share
        return self._gained < -least or (self._gained <= least and self.unfinished)

    @property
    def _is_open(self) -> bool:
        """Whether forces leave more than is called converged after a step with all in hands, or with nothing new."""
        has_all = self._resumes or self._tree.state.item(tl.S_CONTINUES) != 0
        return has_all and self._tree.totals.item(tl.T_EXCESS) > 0.0

    @property
    def _is_tolerable(self) -> bool:
        """Whether the tree's last step may stand though χ² rose: it left a part behind, so that χ² says little yet."""
        totals = self._tree.totals
        chi2, most = totals.item(tl.T_CHI2), MOST_RISE * (totals.item(tl.T_WHOLE) + LEAST_CHI2)
        return self._tree.behind and math.isfinite(chi2) and chi2 <= most

    @property
    def _has_escaped(self) -> bool:
        """Whether the tree's last step left its bounds, where it is to stay within them."""
        return self.within and find_beyond(self._tree.list_changed(self._mark[at.VARIABLES]), self._graph) >= 0

    @property
    def _gained(self) -> float:
        """By how much the tree's last step lowered χ²."""
        return self._tree.totals.item(tl.T_BEFORE) - self._tree.totals.item(tl.T_CHI2)

    @property
    def _share(self) -> float:
        """What shares of χ² are of."""
        return max(self._tree.totals.item(tl.T_CHI2), 0.0) + LEAST_CHI2

    def _is_within(self, share: float, chi2: float) -> bool:
        """Whether χ² is known to be within a share of its optimum where R is not that of Λ, (9.29)."""
        return chi2 + LEAST_CHI2 <= (1.0 + share) * (self._tree.totals.item(tl.T_LEAST) + LEAST_CHI2)

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step, summed anew."""
        return self._sum_chi2(self._mark[at.FACTORS])

    def _look_again(self, looks: bool) -> None:
        """What another step would gain, where raised pivots alone stand against it; with `looks` anyhow."""
        tree, share = self._tree, self._options.converged_share
        asks, after = looks, tree.state.item(tl.S_AFTER)
        if after:
            _, chi2, _, error, allowed, *_ = tree.totals.tolist()
            only_raised = after == tl.RAISED and not tree.state.item(tl.S_CONTINUES)
            asks = only_raised and not tree.behind and error <= allowed and not self._is_within(share, chi2)
        if asks:
            is_left(tree, share)
        elif tree.state.item(tl.S_CONTINUES) and not self.unfinished:
            # Before what is left alone rests: Σ error² takes each force by itself.
            is_left(tree, AT_END)

    def _complete(self, settle: bool, because: str, escaped: bool, bounded: bool) -> tuple[Minimization | None, str]:
        """What has to follow a step, if anything, and why.  Raises NotFinite; all is as before the step then."""
        tree, after = self._tree, self._tree.state.item(tl.S_AFTER)
        chi2, chi2_before = tree.totals.item(tl.T_CHI2), tree.totals.item(tl.T_BEFORE)
        result, before, worse, rises = None, self._graph.values, after & tl.WORSE, after & tl.ROSE
        taken_back = escaped
        continues = self._graph.mark() == self._mark
        share = AT_END if continues else self._options.converged_share
        goes_on = after & tl.RAISED and not bounded and not self._is_within(share, chi2)
        opened = self._is_open and not bounded
        goes_on |= opened
        if settle or escaped or worse or rises or goes_on or self._stalls:
            tree.exchange()
            before = self._graph.values.copy()
            # After a torn estimate a whole one may have the lower χ², and be worse than when nothing was behind.
            taken_back |= bool(worse and not chi2 <= chi2_before) or (continues and self._gained < 0.0)
            if not taken_back:
                tree.exchange()
            result = self._batch(before, settle, continues, taken_back)
            because = why_batch(settle, escaped, bool(worse), bool(rises), opened, bool(goes_on))
            if result:
                last = chi2_before - tree.totals.item(tl.T_CHI2) if continues else math.inf
                # Where what went on with damping hardly gained the next one begins without, as one that settles does.
                anew = result.converged or (self._damping > 0.0 and last <= _HARDLY * self._share)
                self._damping = 0.0 if anew else result.damping
                judge_batch(tree, result, self._options.converged_share, last)
                tree.totals[tl.T_WHOLE], tree.state[tl.S_AFTER] = tree.totals[tl.T_CHI2], 0
            # The tree's own step followed, and what it was before is that of the step.
            tree.totals[tl.T_BEFORE] = chi2_before
        if not math.isfinite(tree.totals[tl.T_CHI2]):
            self._begin_anew(before)
            raise errors.NotFinite("χ² of the estimate after the step")
        return result, because

    def _begin_anew(self, before: F64) -> None:
        """The graph as it was before the step, at the values `before`, and a tree made for it that leaves it there."""
        self._graph.values = before
        self._graph.forget(self._mark)
        self._tree.clear()
        if self._graph.counts[at.VARIABLES]:
            self._tree.step(sure=True)
            self._tree.reset_to_linearization()
            self._at_linearization = True

    def _apart(self) -> FactorGraph:
        """The graph with rows of its own, for equations that leave it as it is."""
        graph = copy.copy(self._graph)
        graph.var, graph.fac = graph.var.copy(), graph.fac.copy()
        return graph

    def _system(self, graph: FactorGraph) -> System:
        """All normal equations at the estimate, apart from the tree."""
        options = self._options
        system = System(graph, Incremental(Elimination(options), options), self._tree.raised)
        system.blocks.extend(graph, _START)
        system.factor.moved()
        return system

    def _batch(self, before: F64, settle: bool, continues: bool, taken_back: bool) -> Minimization:
        """Gauss-Newton or Levenberg-Marquardt on everything from the estimate; the tree follows, and stays where they
        end if its own step from there would raise χ².

        before: the values as they were before the step.  continues: with nothing new.  taken_back: the tree's own step
        was, and so the tree is elsewhere
        """
        options, self.before_batch = self._options, before
        system = self._system(self._graph)
        system.begin(np.empty(0, np.int64), Stopwatch(None))
        system.within = self.within
        chi2 = self._sum_chi2(int(self._graph.counts[at.FACTORS]))
        rule = (further_rule if continues else ordinary_rule)(options, options.batch_tolerance)
        damping = self._damping if continues and not settle and not self._tree.raised else 0.0
        if settle:
            rule = settling_rule(options)
        elif damping:
            rule = replace(rule, nonmonotone=0)
        result = minimize(system, chi2, damping, rule)
        if result.iterations or taken_back or not settle:
            damped = system.rounded and self._tree.state.item(tl.S_RAISED) >= tl.DAMPED
            self._tree.follow(tl.DAMPED if damped else 0, system.diagonal)
            most = result.chi2 * (1.0 + _ROUNDING) + _LEAST_GAIN
            self._at_linearization = not self._tree.totals[tl.T_CHI2] <= most or self._has_escaped
            if self._at_linearization:
                self._tree.reset_to_linearization()
        count = int(self._graph.counts[at.VARIABLES])
        found = np.empty(count, np.int64)
        bits = before.view(np.int64), self._graph.values.view(np.int64)
        self._moved = found[: differing(self._mark[at.VARIABLES], count, self._graph.var, *bits, found)]
        return result

    def _sum_chi2(self, factors: int) -> float:
        graph = self._graph
        return float(sum_chi2(0, factors, graph.var, graph.fac, graph.values, graph.payload))

    def _report(
        self, started: float, compiled: float, result: Minimization | None, because: str, budget: float, clear: bool
    ) -> StepReport:
        """clear: the step has converged, as its status says."""
        before, self._mark = self._mark, self._graph.mark()
        if self._graph.own_before is not None:
            self._graph.own_before = None
        now, clock, tree = self._mark, self._options.clock, self._tree
        self._first_new, self._batched = before[at.VARIABLES], result is not None
        nonzeros, inactive, changed, eliminated, relinearized, _, moved, flops, rounds = tree.state[_COUNTS].tolist()
        compiled_ms = 1e3 * (compiled - started)
        chi2 = max(tree.totals.item(tl.T_CHI2), 0.0)  # a running sum: 0 may come out as less, by rounding
        converged = clear or (result.converged if result else self._has_converged(chi2))
        # In the order of the fields, and by no call that Python would have to bind them for: that takes longer than all
        # the rest.
        return _new(StepReport, (
            "bayes-tree",
            "batch" if result else ("tree" if moved or relinearized else "extend"),
            because or why_tree(relinearized, rounds, tree.state.item(tl.S_CHORDS)),
            result.iterations if result else rounds,
            chi2,
            max(tree.totals.item(tl.T_BEFORE), 0.0),
            now[at.VARIABLES] - before[at.VARIABLES],
            now[at.FACTORS] - now[at.MEMBERS] - before[at.FACTORS] + before[at.MEMBERS],
            self._moved.size if result else changed,
            relinearized,
            eliminated,
            inactive,
            nonzeros,
            float(flops),
            self._damping,
            converged,
            PhaseShares(tl.PHASES, tree.state[_PHASES].tolist(), compiled_ms) if clock else _NO_SHARES,
            1e3 * (clock() - started) if clock else 0.0,
            compiled_ms,
        ) + (self._left(result, budget) if budget else _NO_BUDGET))  # fmt: skip

    def _has_converged(self, chi2: float) -> bool:
        """Whether the tree's own step has, by what it left."""
        tree, totals, share = self._tree, self._tree.totals, self._options.converged_share
        if (
            totals.item(tl.T_ERROR) + totals.item(tl.T_EXCESS) <= totals.item(tl.T_ALLOWED)
            and not (tree.behind or tree.slow)
            and unsolved(tree.state, totals) <= share * (chi2 + LEAST_CHI2)
            and (not tree.raised or self._is_within(share, chi2))
        ):
            return True
        return not self.unfinished

    def _left(self, result: Minimization | None, budget: float) -> tuple[int, float, float, float, bool]:
        """What a step with a budget has left to do, and what it took of it: the last fields of a report."""
        totals = self._tree.totals
        chi2, error, least = (totals.item(k) for k in (tl.T_CHI2, tl.T_ERROR, tl.T_LEAST))
        error += totals.item(tl.T_EXCESS)
        most = min(error + unsolved(self._tree.state, totals), max(chi2, 0.0) - least)
        left = 0.0 if result and result.converged else most
        return self._tree.deferred, left, totals.item(tl.T_WORK), budget, self.complete
