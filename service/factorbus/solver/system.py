"""The least-squares problem of a graph as Gauss-Newton sees it: a point, normal equations, a step, a trial."""

import numpy as np

from factorbus.solver import errors
from factorbus.solver.anchors import find_loose
from factorbus.solver.blocks import Blocks
from factorbus.solver.elimination import Elimination
from factorbus.solver.graph import Graph
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64
from factorbus.solver.kernels.move import differing, inner, move
from factorbus.solver.report import Stopwatch

_FREE_DIRECTION = (
    "together they leave it a direction to move in; add a prior, or a factor that measures what these do not"
)


class System:
    """Λ, η and R of a graph at its present values.  A `gauss_newton.Problem` between `begin` and `end` of a step."""

    def __init__(self, graph: Graph, last_pose_last: bool) -> None:
        self.graph = graph
        self.blocks = Blocks()
        self.elimination = Elimination(last_pose_last)
        self._before: F64 = np.zeros(0)
        self._trial: F64 = np.zeros(0)
        self._moved = False
        self._suspects: I64 = np.zeros(0, np.int64)
        self._watch = Stopwatch(None)

    def begin(self, suspects: I64, watch: Stopwatch) -> None:
        """Remember the values as they are; `suspects` are variables whose place Λ has yet to prove."""
        values = self.graph.values
        if self._trial.size < values.size:
            self._before, self._trial = np.zeros_like(values), np.zeros_like(values)
        used = int(self.graph.counts[at.VALUES])
        self._before[:used] = values[:used]
        self._moved, self._suspects, self._watch = False, suspects, watch

    def factorize(self, damping: float) -> int:
        """Factorise Λ + damping · diag Λ; −1, or the block column whose pivot failed.  Raises Underconstrained."""
        failed = self.elimination.factorize(self.graph, self.blocks, damping, self._watch)
        if self._suspects.size and damping == 0.0:
            if failed >= 0:
                raise self.underconstrained(self.variable_of(failed))
            loose = find_loose(self.graph, self.blocks, self._suspects, self._solve)
            if loose >= 0:
                raise self.underconstrained(loose)
            self._suspects = self._suspects[:0]
        return failed

    def step(self) -> tuple[F64, float]:
        """(δ, δᵀη) by the factor made last and the present gradient."""
        eta = self.blocks.eta[: self.graph.counts[at.SCALARS]]
        step = self._solve(eta)
        return step, float(inner(step, eta))

    def linearise_at(self, step: F64) -> float:
        """χ² at x ⊞ δ, linearised there aside."""
        move(int(self.graph.counts[at.VARIABLES]), self.graph.var, self.graph.values, step, self._trial)
        self._watch.lap("move")
        chi2 = self.blocks.relinearise(self.graph, self._trial)
        self._watch.lap("linearise")
        return chi2

    def accept(self) -> None:
        """Move to the point linearised last."""
        self.graph.values, self._trial = self._trial, self.graph.values
        self.blocks.swap()
        self._moved = True

    def end(self, old: int) -> I64:
        """The variables whose values have other bits than at `begin`, and those from index `old` on."""
        count = int(self.graph.counts[at.VARIABLES])
        changed = np.empty(count, np.int64)
        before, values = self._before.view(np.int64), self.graph.values.view(np.int64)
        changed = changed[: differing(old, count, self.graph.var, before, values, changed)]
        self._moved = False
        self._watch.lap("compare")
        return changed

    def take_back(self, fill: tuple[int, int]) -> None:
        """Values as at `begin`, Λ and η as when the pattern had `fill`; the graph is back at that moment already."""
        if self._moved:
            used = int(self.graph.counts[at.VALUES])
            self.graph.values[:used] = self._before[:used]
            self._moved = False
        self.blocks.forget(self.graph, fill)
        self.elimination.forget()

    def underconstrained(self, variable: int, missing: str = _FREE_DIRECTION) -> errors.Underconstrained:
        """The error that names `variable`, its factors, and what is missing."""
        return errors.Underconstrained(int(self.graph.keys[variable]), self.graph.factors_of(variable), missing)

    def variable_of(self, column: int) -> int:
        """The variable that has this block column."""
        return int(np.flatnonzero(self.graph.var[: self.graph.counts[at.VARIABLES], at.V_COLUMN] == column)[0])

    def _solve(self, eta: F64) -> F64:
        return self.elimination.solve(eta, self._watch)
