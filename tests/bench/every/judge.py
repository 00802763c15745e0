"""χ² of an estimate, and of the batch optimum from there, by full passes over the graph as it is after each step.

The optimum is that of Gauss-Newton on all factors, with Newton's steps or Levenberg-Marquardt's damping where one would
raise χ², begun at the estimate.  Nothing of the incremental solver takes part: each pass linearizes everything, orders
and factorizes it anew.  `oracle` has the same in NumPy and SciPy alone, and the tests hold one against the other.
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from bench.replays.chi2 import UNIT, ratio
from bench.replays.columns import F64, I64

from factorbus.proto.messages import Batch
from factorbus.solver import Group
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.chi2 import sum_chi2
from factorbus.solver.kernels.model.retract import move
from factorbus.solver.sparse.blocks import HessianBlocks
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze

from .newton import newton_steps

COARSE, FINE = 1e-5, 1e-10  # of χ²: where the model of one pass is good enough, and where an optimum is one
_MOST_PASSES = 200
_FIRST_DAMPING, _MOST_DAMPING = 1e-5, 1e12
_ROUNDING, _HARDLY_DAMPED = 1e-12, 1e-2  # of χ²: a step that is damped by so little and wants to gain less ends it


class Look(NamedTuple):
    """One estimate judged.

    chi2: of all factors at the estimate; optimum: at the batch optimum from there.  odometry: over the new odometry
    factors, the most that √(rᵀΩr) at the estimate exceeds the same at the optimum; 0 where there are none.  passes:
    how many it took.
    """

    chi2: float
    optimum: float
    odometry: float
    passes: int

    @property
    def ratio(self) -> float:
        """χ² over the optimum's, 1 at the least: below it is what passes stop at."""
        return max(ratio(self.chi2, self.optimum), 1.0)


class Judge:
    """Takes in what a solver takes in, and judges its estimates."""

    def __init__(self) -> None:
        self._graph, self._blocks, self._cholesky = FactorGraph(), HessianBlocks(), Cholesky()
        self._mark = self._graph.mark()
        self._symbolic: Symbolic | None = None
        self._odometry: list[int] = []
        self._sorted: tuple[I64, I64] = np.empty(0, np.int64), np.empty(0, np.int64)

    def take_in(self, batch: Batch) -> None:
        """The next step."""
        graph, since = self._graph, self._mark
        admit(graph, batch)
        self._blocks.extend(graph, since)
        self._mark, self._symbolic = graph.mark(), None
        keys = graph.keys[: self._mark[at.VARIABLES]]
        ascending = np.argsort(keys)
        self._sorted = keys[ascending], ascending
        self._odometry = [f for f in range(since[at.FACTORS], self._mark[at.FACTORS]) if self._is_odometry(f)]

    def look(self, estimate: Iterable[Group], coarse: float = COARSE) -> Look:
        """Judge an estimate of all variables.  Raises ValueError when one is missing or not finite."""
        start = self._values(estimate)
        chi2, optimum, there, passes = self._minimize(start, coarse)
        excess = [self._root(f, start) - self._root(f, there) for f in self._odometry]
        return Look(chi2, optimum, max(excess, default=0.0), passes)

    def chi2(self, estimate: Iterable[Group]) -> float:
        """Of all factors at an estimate."""
        return self._chi2(self._values(estimate))

    def optimum(self, estimate: Iterable[Group]) -> tuple[float, F64]:
        """χ² and all values, in the order of insertion, at the optimum from an estimate."""
        _, chi2, values, _ = self._minimize(self._values(estimate), FINE)
        return chi2, values[: self._mark[at.VALUES]]

    def _minimize(self, start: F64, coarse: float) -> tuple[float, float, F64, int]:
        """(χ² there, χ² at the optimum, the values of it, passes) from `start`."""
        if not self._mark[at.COLUMNS]:
            chi2 = self._chi2(start)
            return chi2, chi2, start, 0
        x, trial, damping = start, np.empty_like(start), 0.0
        chi2 = first = self._linearize(x)
        for passes in range(1, _MOST_PASSES + 1):
            if self._factorize(damping) >= 0:
                damping = _more(damping)
                continue
            eta = self._blocks.eta[: self._mark[at.SCALARS]]
            d = self._cholesky.forward(eta)
            decrease = float(d @ d)
            small = decrease <= (coarse if passes == 1 else FINE) * max(chi2, UNIT)
            trial = np.empty_like(start)
            move(self._mark[at.VARIABLES], self._graph.var, x, self._cholesky.back(d), trial)
            if small and damping == 0.0:
                return first, min(chi2, self._chi2(trial)), trial, passes
            reached = self._chi2(trial)
            if damping == 0.0 and not reached <= chi2:
                trial, reached = self._best(x, eta.copy(), chi2)
            if not reached <= chi2:
                if 0.0 < damping <= _HARDLY_DAMPED and decrease <= _ROUNDING * max(chi2, UNIT):
                    return first, chi2, x, passes  # undamped steps leave a curved valley, and others find nothing more
                damping = _more(damping)
                continue
            damping = 0.0 if damping < 1e-6 else 0.1 * damping
            x, chi2 = trial, self._linearize(trial)
        return first, chi2, x, _MOST_PASSES

    def _best(self, x: F64, eta: F64, chi2: float) -> tuple[F64, float]:
        """Where one of Newton's steps leads that lowers χ², and χ² there; infinite where none does."""

        def moved(delta: F64) -> F64:
            trial = np.empty_like(x)
            move(self._mark[at.VARIABLES], self._graph.var, x, delta, trial)
            return trial

        def eta_at(delta: F64) -> F64:
            self._blocks.relinearize(self._graph, moved(delta))
            self._blocks.swap_eta()
            return self._blocks.eta[: eta.size].copy()

        solve: Callable[[F64], F64] = lambda g: self._cholesky.back(self._cholesky.forward(g))  # noqa: E731
        for delta in newton_steps(eta, eta_at, solve):
            reached = self._chi2(moved(delta))
            if reached <= chi2:
                return moved(delta), reached
        self._linearize(x)
        return x, np.inf

    def _linearize(self, values: F64) -> float:
        chi2 = self._blocks.relinearize(self._graph, values)
        self._blocks.swap_lambda()
        self._blocks.swap_eta()
        return chi2

    def _factorize(self, damping: float) -> int:
        blocks = self._blocks
        if self._symbolic is None:
            dims = self._graph.dims[: self._mark[at.COLUMNS]]
            self._symbolic = analyze(dims, blocks.rows, blocks.cols, order(dims, blocks.rows, blocks.cols))
        return self._cholesky.factorize(self._symbolic, blocks.data, blocks.offsets, damping)

    def _chi2(self, values: F64) -> float:
        return self._of(0, self._mark[at.FACTORS], values)

    def _root(self, factor: int, values: F64) -> float:
        return float(np.sqrt(max(self._of(factor, factor + 1, values), 0.0)))

    def _of(self, first: int, last: int, values: F64) -> float:
        graph = self._graph
        return float(sum_chi2(first, last, graph.var, graph.fac, values, graph.payload))

    def _values(self, estimate: Iterable[Group]) -> F64:
        """The estimate as the kernels take it."""
        keys, ascending = self._sorted
        values = np.full_like(self._graph.values, np.nan)
        for group in estimate:
            places = np.searchsorted(keys, group.keys)
            if (keys[np.minimum(places, len(keys) - 1)] != group.keys).any():
                raise ValueError(f"an estimate has keys of {group.kind} that no step brought")
            starts = self._graph.var[ascending[places], at.V_AT]
            values[starts[:, None] + np.arange(group.values.shape[1])] = group.values
        if not np.isfinite(values[: self._mark[at.VALUES]]).all():
            raise ValueError("an estimate lacks a variable, or has one that is not finite")
        return values

    def _is_odometry(self, factor: int) -> bool:
        """Between poses that follow each other."""
        kind, i, j = self._graph.fac[factor, [at.F_KIND, at.F_I, at.F_J]].tolist()
        between = kind in (at.BETWEEN_SE2, at.BETWEEN_SE3)
        return between and abs(int(self._graph.keys[i]) - int(self._graph.keys[j])) == 1


def _more(damping: float) -> float:
    """Ten times as much.  Raises ArithmeticError when that has no use any more."""
    if damping > _MOST_DAMPING:
        raise ArithmeticError("no step lowers χ², however short: the graph is not held, or the kernels are wrong")
    return max(10.0 * damping, _FIRST_DAMPING)
