"""One graph, minimized from several starts in turn: the pattern of Λ and the order of R are the same for all.

A start that is on its way to where another one is already, or hopelessly above it, is not finished.  MATH §12.6.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.inc_l.incremental import Incremental
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.optimize.gauss_newton import Minimization, StoppingRule, minimize
from factorbus.solver.optimize.system import System
from factorbus.solver.options import Options
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.anchors import find_unanchored, find_undetermined
from factorbus.solver.sparse.elimination import WholeElimination
from factorbus.solver.sparse.symbolic import Symbolic
from factorbus.solver.starts.same_place import SamePlace
from factorbus.solver.starts.search import ROTATIONS, STARTS, BatchEvents, BatchSearch, NoEvents
from factorbus.solver.tuning import Tuning

_POLISH = 100
# Without polishing, a search ends where another step would lower χ² by less than this share of it.
_UNPOLISHED = 1e-11
# Where R takes more than this number of operations for each scalar, it makes further steps while each is to gain less
# than this share of the one before: they take a fifth of one that makes R anew.
_DEAR, _REUSE = 3e4, 0.5
# Tries at a time: of the lowest start first, of others; and at most of one that is not the best when another converged.
_FIRST_CHUNK, _CHUNK, _MOST_OF_OTHERS = 8, 4, 60
# Two starts are on the way to the same optimum when they are in the same place (`SamePlace`), or differ in χ² by less
# than _SAME_CHI2 of it while it falls by less than _SLOW in a chunk.
_SAME_CHI2, _SLOW = 1e-3, 1e-2
# A start is hopeless if this number of chunks as good as its last one would not bring it below the best; and where two
# starts have met, one that is this many times above them after its first chunk.
_PATIENCE, _FAR = 2, 2.0
# Averaged rotations that began within this of where they ended were nearly the optimum: the convex problem that they
# solve leaves no room for a better one to a start that begins this many times above their end.
_TIGHT, _ABOVE = 2.0, 10.0
# Ends whose χ² differ by less than this share are one: of those, the start that comes first in the list counts.
_EQUAL = 1e-9
NOTHING = Options().tuning.chi2_epsilon
_USUAL, _NOBODY = BatchSearch(), NoEvents()
# Bytes of a factor while rotations are averaged: what it says in matrices, several times over.
_AVERAGED_FACTOR = 2000


@dataclass(slots=True)
class Descent:
    """A start, and how far down it has come.

    began: χ² of the start.  rate: χ² before its last chunk over χ² after it.  left: what another step would take off.
    met: another start was on the way to where this one is.
    """

    start: str
    values: F64
    chi2: float
    began: float = np.inf
    damping: float = 0.0
    iterations: int = 0
    tries: int = 0
    rate: float = np.inf
    left: float = np.inf
    converged: bool = False
    ended: bool = False
    met: bool = False


class Descents:
    """The problem that all starts have in common.  Raises Underconstrained: nothing joins a variable to the map."""

    def __init__(self, graph: FactorGraph, search: BatchSearch = _USUAL, events: BatchEvents = _NOBODY) -> None:
        options = Options(mode="all-batch", tuning=Tuning(constrain_last_pose=False))
        tuning = options.tuning
        self._rule = StoppingRule(
            tuning.converge_tolerance if search.polish else _UNPOLISHED, 1e-8 * tuning.chi2_epsilon, 0,
            polish=_POLISH if search.polish else 0, newton=True,
        )  # fmt: skip
        self._hills = tuning.max_nonmonotone_steps
        self._search, self._events = search, events
        self.graph, none = graph, (0,) * at.COUNTS
        self.are_close = SamePlace(graph)
        self._system = System(graph, Incremental(WholeElimination(options), options))
        self._suspects = find_undetermined(graph, none)
        if self._suspects.size and (free := find_unanchored(graph, none)) >= 0:
            raise self._system.underconstrained(
                free,
                "nothing joins it to a fixed variable or a prior; fix a variable, or add a prior or a factor to the "
                "rest of the map",
            )
        self._system.blocks.extend(graph, none)

    def order(self) -> I64:
        """The block columns of Λ as R eliminates them."""
        return self._analyzed().order

    def memory_bytes(self) -> int:
        """Bytes that the graph, Λ and R take, and the most that a start takes beside these; Λ is ordered for it."""
        symbolic, counts = self._analyzed(), self.graph.counts
        pattern = symbolic.blocks.nbytes + symbolic.fronts.nbytes + symbolic.runs.nbytes + symbolic.separator.nbytes
        factors, averaging = 8 * symbolic.arena, _AVERAGED_FACTOR * int(counts[at.FACTORS]) + 4 * symbolic.arena
        return self.graph.memory_bytes() + self._system.memory_bytes() - factors + pattern + max(factors, averaging)

    def _analyzed(self) -> Symbolic:
        return self._system.factor.elimination.analyze(self.graph, self._system.blocks, Stopwatch(None))

    def begin(self, start: str, values: F64) -> Descent:
        """A start.  Raises NotFinite where it has no χ²."""
        chi2 = self.chi2(values)
        if not np.isfinite(chi2):
            raise errors.NotFinite(f"χ² of the start {start!r}")
        return Descent(start, values, chi2, began=chi2)

    def chi2(self, values: F64) -> float:
        """Σ rᵀ Ω r at `values`."""
        graph = self.graph
        factors = int(graph.counts[at.FACTORS])
        return max(float(sum_chi2(0, factors, graph.var, graph.fac, values, graph.payload)), 0.0)

    def run(self, descents: list[Descent]) -> Descent:
        """The lowest end of all of them.  Raises Underconstrained if that is what each of them is."""
        failed: errors.SolverError | None = None
        while going := [each for each in descents if not each.ended]:
            for each in going:
                if any(_is_hopeless(each, other) for other in descents if other is not each):
                    each.ended = True
                    continue
                try:
                    self._go_on(each, alone=len(descents) == 1, first=each is descents[0])
                except errors.Underconstrained as problem:
                    failed = failed or problem
                    descents.remove(each)
                    continue
                over = [self._is_over(each, other) for other in descents if other is not each]
                each.ended = True in over or each.converged or each.tries >= self._search.max_iterations
        if failed is not None and not descents:
            raise failed
        lowest = min(each.chi2 for each in descents)
        equal = [each for each in descents if each.chi2 <= lowest * (1.0 + _EQUAL) + NOTHING]
        return min(equal, key=lambda each: (not each.converged, STARTS.index(each.start)))

    def _go_on(self, descent: Descent, alone: bool, first: bool) -> None:
        """The next few tries; all that there may be if there is no other start."""
        graph, system = self.graph, self._system
        graph.values = descent.values.copy()
        system.begin(self._suspects, Stopwatch(None))
        if graph.counts[at.COLUMNS] == 0:
            descent.converged = True
            return
        system.anew()
        tries = self._search.max_iterations - descent.tries
        if not alone:
            tries = min(tries, _FIRST_CHUNK if first and not descent.tries else _CHUNK)
        dear = self._analyzed().flops > _DEAR * int(graph.counts[at.SCALARS])
        hills = self._hills if descent.damping == 0.0 else 0
        rule = replace(self._rule, limit=tries, nonmonotone=hills, reuse=_REUSE if dear else 0.0)
        result = minimize(system, descent.chi2, descent.damping, rule, tell=self._telling(descent))
        if result.failed >= 0 and result.iterations == 0:
            raise system.underconstrained(system.variable_of(result.failed))
        descent.rate = descent.chi2 / result.chi2 if result.chi2 > 0.0 else np.inf
        descent.values, descent.chi2, descent.damping = graph.values, max(result.chi2, 0.0), result.damping
        descent.iterations += result.iterations
        descent.tries += tries
        descent.converged, descent.left = result.converged, result.left

    def _is_over(self, descent: Descent, other: Descent) -> bool:
        """Whether `other` makes it needless to go on."""
        if not other.tries or descent.chi2 < other.chi2:
            return False
        level = descent.chi2 <= (1.0 + _SAME_CHI2) * other.chi2 and (descent.converged or descent.rate < 1.0 + _SLOW)
        if self.are_close(descent.values, other.values) or (other.converged and level):
            other.met = True
            return True
        if other.converged and descent.tries >= _MOST_OF_OTHERS:
            return True
        if other.met and descent.chi2 > _FAR * other.chi2:
            return True
        return descent.tries > _CHUNK and descent.chi2 > other.chi2 * descent.rate**_PATIENCE

    def _telling(self, descent: Descent) -> Callable[[Minimization], None]:
        before = descent.iterations

        def tell(result: Minimization) -> None:
            self._events.on_iteration(descent.start, before + result.iterations, result.chi2, result.damping)

        return tell


def _is_hopeless(descent: Descent, other: Descent) -> bool:
    """Whether a start that has not been tried need not be."""
    return (
        (other.converged or other.left <= _SAME_CHI2 * other.chi2)
        and other.start == ROTATIONS
        and other.began <= _TIGHT * other.chi2
        and not descent.tries
        and descent.chi2 > _ABOVE * other.chi2
    )
