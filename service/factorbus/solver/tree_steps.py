"""Steps in the mode "tree": the tree of cliques does the work, and Levenberg-Marquardt on all of Λ is behind it.

A step solves a linear problem and is taken as it is where nothing bends far (MATH §9.6).  Where something does, χ² is
compared with what it was, and a step that would raise it is replaced by a batch from where the estimate stood.
"""

import numpy as np

from factorbus.solver import errors
from factorbus.solver.anchors import find_unanchored, find_unheld
from factorbus.solver.elimination import Elimination
from factorbus.solver.gauss_newton import Course, Rule, minimise
from factorbus.solver.graph import Graph, Mark
from factorbus.solver.incremental import Incremental
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import I64
from factorbus.solver.kernels.chi2 import sum_chi2
from factorbus.solver.kernels.settle_new import settle_new
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport, Stopwatch
from factorbus.solver.system import System
from factorbus.solver.tree import Tree

_FEW = 8  # new variables for which good first values are looked for
_START: Mark = (0,) * at.COUNTS


class TreeSteps:
    """Solves for what is new in a graph, step by step."""

    def __init__(self, graph: Graph, options: Options) -> None:
        self._graph, self._options = graph, options
        self._tree = Tree(graph, options)
        self._mark = graph.mark()
        self._first_new, self._batched = 0, False

    @property
    def tree(self) -> Tree:
        """For tests."""
        return self._tree

    def step(self, settle: bool) -> StepReport:
        """As `Solver.step`."""
        watch = Stopwatch(self._options.clock)
        try:
            self._place_new()
            because = self._check_held()
            watch.lap("check")
            failed = self._tree.step()
            watch.lap("compiled")
            if failed >= 0:
                raise self._loose(failed)
        except BaseException:
            self._graph.forget(self._mark)
            raise
        course = None
        if settle:
            course, because = self._batch(settle=True), "asked to settle"
        elif self._is_worse():
            course, because = self._batch(settle=False), "χ² would have risen: a batch from where the estimate stood"
        return self._account(watch, course, because)

    def changed(self) -> I64:
        """The variables whose values have other bits than before the last step, new ones included."""
        if self._batched:
            return np.arange(int(self._graph.counts[at.VARIABLES]))
        return self._tree.list_moved(self._first_new)

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        return self._sum_chi2(self._mark[at.FACTORS])

    def _place_new(self) -> None:
        mark, counts = self._mark, self._graph.counts.tolist()
        if counts[at.VARIABLES] - mark[at.VARIABLES] <= _FEW and self._options.place_new:
            settle_new(
                mark[at.VARIABLES], counts[at.VARIABLES], mark[at.FACTORS], counts[at.FACTORS],
                self._options.negligible, self._graph.var, self._graph.fac, self._graph.values, self._graph.payload,
            )  # fmt: skip

    def _check_held(self) -> str:
        """Refuse new variables that nothing holds; gives what the step is done for.  Raises Underconstrained."""
        suspects = find_unheld(self._graph, self._mark)
        if suspects.size:
            free = find_unanchored(self._graph, self._mark)
            system = self._system()
            if free >= 0:
                raise system.underconstrained(
                    free,
                    "nothing joins it to a fixed variable or a prior; fix a variable, or add a prior or a factor to "
                    "the rest of the map",
                )
            system.begin(suspects, Stopwatch(None))
            system.factorize(0.0)
            return f"{suspects.size} new variables are held only by several factors together"
        return ""

    def _loose(self, variable: int) -> errors.Underconstrained:
        return self._system().underconstrained(variable)

    def _system(self) -> System:
        """All normal equations at the estimate, apart from the tree."""
        options = self._options
        system = System(self._graph, Incremental(Elimination(options), options))
        system.blocks.extend(self._graph, _START)
        system.factor.moved()
        return system

    def _is_worse(self) -> bool:
        """Whether a step that bent something far raised χ²; the estimate is then what it was before."""
        if not self._tree.account[tl.A_BEND] > self._options.trust:
            return False
        factors = int(self._graph.counts[at.FACTORS])
        after = self._sum_chi2(factors)
        self._tree.exchange()
        if not after <= self._sum_chi2(factors):
            return True
        self._tree.exchange()
        return False

    def _batch(self, settle: bool) -> Course:
        """Gauss-Newton or Levenberg-Marquardt on everything from the estimate; the tree follows."""
        options = self._options
        system = self._system()
        system.begin(np.empty(0, np.int64), Stopwatch(None))
        chi2 = self._sum_chi2(int(self._graph.counts[at.FACTORS]))
        rule = Rule(options.tolerance, options.negligible, options.max_iterations)
        if settle:
            rule = Rule(options.settle_tolerance, 1e-8 * options.negligible, options.settle_iterations)
        course = minimise(system, chi2, 0.0, rule)
        self._tree.move_all()
        self._tree.step()
        self._batched = True
        return course

    def _sum_chi2(self, factors: int) -> float:
        graph = self._graph
        return float(sum_chi2(0, factors, graph.var, graph.fac, graph.values, graph.payload))

    def _account(self, watch: Stopwatch, course: Course | None, because: str) -> StepReport:
        state, tree = self._tree.state, self._tree
        counts = self._graph.mark()
        before, self._mark = self._mark, counts
        self._first_new, self._batched = before[at.VARIABLES], course is not None
        eliminated, relinearised, _, changed, flops = state[tl.S_ELIMINATED : tl.S_FLOPS + 1].tolist()
        chi2 = self.chi2() if course else float(tree.account[tl.A_CHI2])
        total = watch.total_ms()
        cycles = state[tl.S_CYCLES : tl.S_CYCLES + len(tl.PHASES)].tolist()
        share = watch.phases_ms.get("compiled", 0.0) / max(sum(cycles), 1)
        return StepReport(
            mode="tree",
            strategy="batch" if course else ("tree" if changed or relinearised else "extend"),
            because=because or f"{relinearised} variables bent too far",
            iterations=course.iterations if course else int(state[tl.S_ROUNDS]),
            chi2=chi2,
            chi2_before=chi2,
            new_variables=counts[at.VARIABLES] - before[at.VARIABLES],
            new_factors=counts[at.FACTORS] - before[at.FACTORS],
            changed=changed,
            relinearised=relinearised,
            eliminated=eliminated,
            nnz_r=int(state[tl.S_NONZEROS]),
            flops=float(flops),
            converged=course.converged if course else True,
            phases_ms={name: share * count for name, count in zip(tl.PHASES, cycles, strict=True)},
            step_ms=total,
            compiled_ms=watch.phases_ms.get("compiled"),
        )
