"""Steps in the mode "tree": the tree of cliques does the work, and Levenberg-Marquardt on all of Λ is behind it.

A step solves a linear problem and is taken as it is where nothing bends far (MATH §9.6).  Where something does, χ² is
compared with what it was, and a step that would raise it is replaced by a batch from where the estimate stood.
"""

import copy

import numpy as np

from factorbus.solver import errors
from factorbus.solver.anchors import find_unanchored, find_unheld
from factorbus.solver.elimination import Elimination
from factorbus.solver.gauss_newton import Course, Rule, minimise
from factorbus.solver.graph import Graph, Mark
from factorbus.solver.incremental import Incremental
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import F64, I64
from factorbus.solver.kernels.chi2 import sum_chi2
from factorbus.solver.kernels.move import differing
from factorbus.solver.options import Options
from factorbus.solver.report import Shares, StepReport, Stopwatch
from factorbus.solver.system import System
from factorbus.solver.tree import Tree

_START: Mark = (0,) * at.COUNTS
_POLISH = 100
_COUNTS = tl.S_CYCLES - tl.S_TOLD_FROM
_NONE_BENT = "0 variables bent too far"
_new = tuple.__new__


class TreeSteps:
    """Solves for what is new in a graph, step by step."""

    NOT_KEPT = ("_graph", "_options")

    def __init__(self, graph: Graph, options: Options) -> None:
        self._graph, self._options = graph, options
        self._tree = Tree(graph, options)
        self._mark = graph.mark()
        self._first_new, self._batched = 0, False
        self._moved: I64 = np.empty(0, np.int64)  # by a batch

    @property
    def tree(self) -> Tree:
        """For tests."""
        return self._tree

    def step(self, settle: bool) -> StepReport:
        """As `Solver.step`."""
        clock = self._options.clock
        started = clock() if clock else 0.0
        tree, because = self._tree, ""
        try:
            status = tree.step()
            if status == tl.UNSURE:
                because = self._check_held()
                status = tree.step(sure=True)
            if status == tl.FAILED:
                raise self._system(self._apart()).underconstrained(tree.failed)
            if status == tl.INFINITE:
                raise errors.NotFinite("χ² of the new factors")
        except BaseException:
            self._graph.forget(self._mark)
            raise
        compiled = clock() if clock else 0.0
        course, account = None, tree.account.tolist()
        if settle and self._graph.counts[at.COLUMNS]:
            tree.exchange()
            before = self._graph.values.copy()
            tree.exchange()
            course, because = self._batch(before, settle=True), "asked to settle"
        elif account[tl.A_BEND] > self._options.trust and self._is_worse():
            before = self._graph.values.copy()
            course = self._batch(before, settle=False)
            because = "χ² would have risen: a batch from where the estimate stood"
        chi2 = self._sum_chi2(int(self._graph.counts[at.FACTORS])) if course else account[tl.A_CHI2]
        return self._account(started, compiled, course, max(chi2, 0.0), because)

    def changed(self) -> I64:
        """The variables whose values have other bits than before the last step, new ones included."""
        if self._batched:
            return self._moved
        return self._tree.list_moved(self._first_new)

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        return max(self._sum_chi2(self._mark[at.FACTORS]), 0.0)  # pieces of a form sum to zero but for rounding

    def _check_held(self) -> str:
        """Refuse new variables that nothing holds; gives why the others were looked at.  Raises Underconstrained."""
        suspects = find_unheld(self._graph, self._mark)
        if not suspects.size:
            return ""
        free = find_unanchored(self._graph, self._mark)
        system = self._system(self._apart())
        if free >= 0:
            raise system.underconstrained(
                free,
                "nothing joins it to a fixed variable or a prior; fix a variable, or add a prior or a factor to the "
                "rest of the map",
            )
        system.begin(suspects, Stopwatch(None))
        system.factorize(0.0)
        return f"{suspects.size} new variables are held only by several factors together"

    def _apart(self) -> Graph:
        """The graph with rows of its own, for equations that leave it as it is."""
        graph = copy.copy(self._graph)
        graph.var, graph.fac = graph.var.copy(), graph.fac.copy()
        return graph

    def _system(self, graph: Graph) -> System:
        """All normal equations at the estimate, apart from the tree."""
        options = self._options
        system = System(graph, Incremental(Elimination(options), options))
        system.blocks.extend(graph, _START)
        system.factor.moved()
        return system

    def _is_worse(self) -> bool:
        """Whether the step raised χ²; the estimate is then what it was before."""
        factors = int(self._graph.counts[at.FACTORS])
        after = self._sum_chi2(factors)
        self._tree.exchange()
        if not after <= self._sum_chi2(factors):
            return True
        self._tree.exchange()
        return False

    def _batch(self, before: F64, settle: bool) -> Course:
        """Gauss-Newton or Levenberg-Marquardt on everything from the estimate; the tree follows.

        before: the values as they were before the step
        """
        options = self._options
        system = self._system(self._graph)
        system.begin(np.empty(0, np.int64), Stopwatch(None))
        chi2 = self._sum_chi2(int(self._graph.counts[at.FACTORS]))
        rule = Rule(options.tolerance, options.negligible, options.max_iterations)
        if settle:
            rule = Rule(options.settle_tolerance, 1e-8 * options.negligible, options.settle_iterations, polish=_POLISH)
        course = minimise(system, chi2, 0.0, rule)
        if course.iterations or not settle:
            self._tree.move_all()
            self._tree.step()
        count = int(self._graph.counts[at.VARIABLES])
        found = np.empty(count, np.int64)
        bits = before.view(np.int64), self._graph.values.view(np.int64)
        self._moved = found[: differing(self._mark[at.VARIABLES], count, self._graph.var, *bits, found)]
        return course

    def _sum_chi2(self, factors: int) -> float:
        graph = self._graph
        return float(sum_chi2(0, factors, graph.var, graph.fac, graph.values, graph.payload))

    def _account(self, started: float, compiled: float, course: Course | None, chi2: float, because: str) -> StepReport:
        before, self._mark = self._mark, self._graph.mark()
        now, clock = self._mark, self._options.clock
        self._first_new, self._batched = before[at.VARIABLES], course is not None
        told = self._tree.state[tl.S_TOLD_FROM : tl.S_TOLD_TO].tolist()
        nonzeros, asleep, changed, eliminated, relinearised, _, moved, flops, rounds = told[:_COUNTS]
        compiled_ms = 1e3 * (compiled - started)
        # In the order of the fields, and by no call that Python would have to bind them for: that takes longer than all
        # the rest.
        return _new(StepReport, (
            "tree",
            "batch" if course else ("tree" if moved or relinearised else "extend"),
            because or (_bent(relinearised, rounds) if relinearised else _NONE_BENT),
            course.iterations if course else rounds,
            chi2,  # chi2
            chi2,  # chi2_before
            now[at.VARIABLES] - before[at.VARIABLES],
            now[at.FACTORS] - before[at.FACTORS],
            self._moved.size if course else changed,
            relinearised,
            eliminated,
            asleep,
            nonzeros,
            float(flops),
            0.0,  # damping
            course.converged if course else True,
            Shares(tl.PHASES, told[_COUNTS:], compiled_ms),
            1e3 * (clock() - started) if clock else 0.0,
            compiled_ms,
        ))  # fmt: skip


def _bent(relinearised: int, rounds: int) -> str:
    """Why variables were relinearised.  In several rounds one variable counts as often as it was."""
    if rounds > 1:
        return f"variables bent too far: {relinearised} relinearisations in {rounds} rounds"
    return f"{relinearised} variable{'s' if relinearised > 1 else ''} bent too far"
