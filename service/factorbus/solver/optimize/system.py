"""The least-squares problem of a graph as Gauss-Newton sees it: a point, normal equations, a step, a trial."""

import math
from functools import partial
from typing import Generic, TypeVar

import numpy as np

from factorbus.solver import errors
from factorbus.solver.graph.escaped import are_all_within
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.multiply_hessian import multiply_hessian
from factorbus.solver.kernels.model.retract import differing, move
from factorbus.solver.kernels.sparse.partial_cholesky import ROUNDING
from factorbus.solver.optimize.conjugate import ConjugateGradients, iterate, precondition_by
from factorbus.solver.optimize.factor import Factor
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.anchors import find_loose, find_loose_by_themselves
from factorbus.solver.sparse.blocks import HessianBlocks
from factorbus.solver.sparse.full_rank import have_full_rank

R = TypeVar("R", bound=Factor)

# How many times what counts as rounding a pivot has to be for R without damping to be tried again: with 4 steps beside
# links of 1e-6 m that had gone back to R were left open.
_FAR = 256.0
# Of (6.5): the largest entry, in metres and radians, of what gradients are a difference along; the share of the
# decrease at which its iterations end, and at most how many there are.
_DIFFERENCE, _NEWTON_LEFT, _NEWTON_ITERATIONS = 1e-6, 1e-4, 25
_LEAST_NORMAL = 2.0**-1022
_FREE_DIRECTION = (
    "together they leave it a direction to move in; add a prior, or a factor that measures what these do not"
)


class System(Generic[R]):
    """Λ, η and R of a graph at its present values.  A `LeastSquares` between `begin` and `end` of a step.

    within: what would leave its bounds counts as having an infinite χ², so that no step leads there
    rounded: R has lost to rounding what some factors say, so steps are made by conjugate gradients, until it has not
    """

    NOT_KEPT = ("_before", "_exact", "_kept", "_moved", "_suspects", "_trial", "_watch", "graph", "within")

    def __init__(self, graph: FactorGraph, factor: R, rounded: bool = False) -> None:
        self.graph = graph
        self.blocks = HessianBlocks()
        self.factor, self.rounded = factor, rounded
        self._exact = ConjugateGradients(factor)
        self._before: F64 = np.zeros(0)
        self._kept: F64 = np.zeros(0)
        self._trial: F64 = np.zeros(0)
        self._moved, self.within = False, False
        self._have_lambda, self.drifted = True, False
        self._spare_is_here = False
        self.drifted = False  # η is that of the linear model, not of the present point
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
        self._spare_is_here = False

    def factorize(self, damping: float) -> int:
        """Factorize Λ + damping · diag Λ; −1, or the block column whose pivot failed.  Raises Underconstrained."""
        if not self.drifted:
            self.have_lambda()
        failed = self._solver.factorize(self.graph, self.blocks, damping, self._watch)
        if self.rounded and damping == 0.0 and failed < 0 and not self._suspects.size and self._may_have_found():
            self.rounded = False
            failed = self.factor.factorize(self.graph, self.blocks, damping, self._watch)
        if failed >= 0:
            failed = self._factorize_rest(failed, damping)
        if damping == 0.0 and self._suspects.size:
            self._check_suspects(failed)
            self._suspects = self._suspects[:0]
        if damping == 0.0 and not self.rounded:
            self.rounded = failed >= 0 or self._has_lost()
            if self.rounded:
                failed = self._solver.factorize(self.graph, self.blocks, damping, self._watch)
        return failed

    def serve(self) -> bool:
        """Solve with the R that is there, if there is one that has lost nothing."""
        if self.rounded or not self.factor.serve():
            return False
        self.rounded = self._has_lost()
        return not self.rounded

    def decrease(self) -> float:
        """dᵀd = δᵀη by the factor made last and the present gradient."""
        return self._solver.decrease(self.blocks.eta[: self.graph.counts[at.SCALARS]], self._watch)

    def step(self) -> F64:
        """The δ of the last `decrease`."""
        return self._solver.step(self._watch)

    def present_decrease(self, certain: float) -> float:
        """δᵀη with Λ δ = η, Λ of the present point, by conjugate gradients; R is the preconditioner, and that of
        another point.  Until no more than `certain` is left by R.  MATH (6.4)"""
        eta = self.blocks.eta[: self.graph.counts[at.SCALARS]]

        def multiply(p: F64) -> F64:
            out = np.zeros_like(p)
            multiply_hessian(self.graph.array_table, p, out)
            return out

        precondition = partial(precondition_by, self.factor, self._watch)
        found, _ = iterate(eta, multiply, precondition, 0.0, _NEWTON_ITERATIONS, certain)
        self.decrease()  # d is that of η again
        return found

    def newton_step(self) -> F64 | None:
        """δ with H δ = η, H the Hessian of χ² with its terms of second order; None where R has lost to rounding.

        By conjugate gradients, R of the last undamped `factorize` as preconditioner; H p is a difference of gradients.
        Where H is not positive definite δ is along what of it was found to be, or that of Gauss-Newton.  MATH (6.5)
        """
        if self.rounded:
            return None
        eta = self.blocks.eta[: self.graph.counts[at.SCALARS]].copy()

        def multiply(p: F64) -> F64:
            size = _DIFFERENCE / max(float(np.abs(p).max()), _LEAST_NORMAL)
            if not math.isfinite(self.linearize_at(size * p)):
                return np.full_like(eta, np.nan)
            self.blocks.swap_eta()
            there = self.blocks.eta[: eta.size].copy()
            self.blocks.swap_eta()
            return (eta - there) / size

        precondition = partial(precondition_by, self.factor, self._watch)
        found, step = iterate(eta, multiply, precondition, _NEWTON_LEFT, _NEWTON_ITERATIONS)
        return step if found > 0.0 else precondition(eta)[1]

    def linearize_at(self, step: F64) -> float:
        """χ² at x ⊞ δ, linearized there aside."""
        move(int(self.graph.counts[at.VARIABLES]), self.graph.var, self.graph.values, step, self._trial)
        self._watch.lap("move")
        self._spare_is_here = False
        if self.within and not are_all_within(self.graph, self._trial):
            return math.inf
        chi2 = self.blocks.relinearize(self.graph, self._trial)
        self._watch.lap("linearize")
        return chi2

    def accept(self) -> None:
        """Move to the point linearized last: η is that of the new point, Λ stays until it is asked for."""
        self.graph.values, self._trial = self._trial, self.graph.values
        self.blocks.swap_eta()
        self.factor.turned()
        self._have_lambda, self._spare_is_here, self._moved = False, True, True

    def keep(self) -> None:
        """Remember the values as they are."""
        self._kept = self.graph.values[: self.graph.counts[at.VALUES]].copy()

    def go_back(self) -> None:
        """The values that were kept; Λ and η are made there anew."""
        self.graph.values[: self._kept.size] = self._kept
        self.anew()

    def accept_linear(self) -> float:
        """Move to the point linearized last; Λ, R and the linear model stay.

        Return what the true gradient there, with R, says that another step would take off χ².
        """
        self.graph.values, self._trial = self._trial, self.graph.values
        self.blocks.swap_eta()
        self.factor.turned()
        self._have_lambda, self._spare_is_here, self._moved, self.drifted = False, False, True, True
        return self.decrease()

    def rest(self) -> None:
        """η is that of the linear model from here on, which is zero."""
        self.blocks.eta[: self.graph.counts[at.SCALARS]] = 0.0
        self._solver.rest()

    def relinearize(self) -> None:
        """Λ and η at the present point, if they are not."""
        if self.drifted:
            self.have_lambda()
            self.blocks.swap_eta()
            self.drifted = False

    def have_lambda(self) -> None:
        """Λ at the present point (haveΛ of the 2013 paper)."""
        if self._have_lambda:
            return
        if not self._spare_is_here:
            self.blocks.relinearize(self.graph, self.graph.values)
            self._watch.lap("linearize")
        self.blocks.swap_lambda()
        self.factor.moved()
        self._have_lambda, self._spare_is_here = True, False

    def diagonal(self) -> F64:
        """That of Λ at the present point, in insertion order."""
        self.have_lambda()
        return self.blocks.data[self.blocks.diagonal(self.graph)]

    def anew(self) -> None:
        """Λ and η at the present point: what the factors measure, or weigh, is other than it was."""
        self._have_lambda, self._spare_is_here = False, False
        self.have_lambda()
        self.blocks.swap_eta()

    def end(self, old: int) -> I64:
        """The variables whose values have other bits than at `begin`, and those from index `old` on."""
        count = int(self.graph.counts[at.VARIABLES])
        changed = np.empty(count, np.int64)
        before, values = self._before.view(np.int64), self.graph.values.view(np.int64)
        changed = changed[: differing(old, count, self.graph.var, before, values, changed)]
        self._moved = False
        self._watch.lap("compare")
        return changed

    def restore(self) -> None:
        """Put the values as at the last `begin` back into the graph."""
        used = int(self.graph.counts[at.VALUES])
        self.graph.values[:used] = self._before[:used]

    def take_back(self, fill: tuple[int, int]) -> None:
        """Values as at `begin`, Λ and η as when the pattern had `fill`; the graph is back at that moment already."""
        if self._moved:
            self.restore()
            self._moved = False
        self.blocks.forget(self.graph, fill)
        self._have_lambda, self.drifted = True, False
        self.factor.forget()

    def memory_bytes(self) -> int:
        """Bytes in use for Λ, η (both twice) and R."""
        blocks, numbers = self.blocks.fill.tolist()
        scalars = int(self.graph.counts[at.SCALARS])
        return 8 * (3 * blocks + 2 * (numbers + scalars)) + self.factor.memory_bytes()

    def underconstrained(self, variable: int, missing: str = _FREE_DIRECTION) -> errors.Underconstrained:
        """The error that names `variable`, its factors, and what is missing."""
        return errors.Underconstrained(int(self.graph.keys[variable]), self.graph.factors_of(variable), missing)

    def variable_of(self, column: int) -> int:
        """The variable that has this block column."""
        return int(np.flatnonzero(self.graph.var[: self.graph.counts[at.VARIABLES], at.V_COLUMN] == column)[0])

    @property
    def _solver(self) -> Factor:
        """What makes steps."""
        return self._exact if self.rounded else self.factor

    def _has_lost(self) -> bool:
        """Whether a pivot is no more than the rounding of the largest entry."""
        return self.factor.least_pivot() <= ROUNDING * self.blocks.largest()

    def _check_suspects(self, failed: int) -> None:
        """Raises Underconstrained where the suspects are free to move; failed: the column of a pivot, or −1."""
        loose, suspects = -1, self._suspects
        if failed >= 0:
            loose = self.variable_of(failed)
        elif self.rounded:
            loose, suspects = find_loose_by_themselves(self.graph, self.blocks, suspects)
        if loose < 0 and suspects.size:
            loose = find_loose(self.graph, self.blocks, suspects, self._solve)
        if loose >= 0 and not have_full_rank(self.graph, self._suspects):
            raise self.underconstrained(loose)

    def _may_have_found(self) -> bool:
        """Whether what R had lost may be known well by now, as where positions came after a weak first prior: R of Λ
        that is damped least has no pivot that is near rounding."""
        near = _FAR * ROUNDING * self.blocks.largest()
        return self._exact.damped_least and self.factor.least_pivot() > near

    def _factorize_rest(self, failed: int, damping: float) -> int:
        """Factorize Λ with ones where its diagonal is zero, `suspects` apart: what every loss has set aside rests
        where it is, as η is zero there, and the rest moves.  −1, or the block column whose pivot failed."""
        free = np.flatnonzero(self.graph.var[: self.graph.counts[at.VARIABLES], at.V_COLUMN] >= 0)
        resting = self.blocks.unweighted(self.graph, np.setdiff1d(free, self._suspects, assume_unique=True))
        if resting.size:
            entries = self.blocks.put_ones(self.graph, resting)
            failed = self._solver.factorize(self.graph, self.blocks, damping, self._watch)
            self.blocks.data[entries] = 0.0
            self.factor.moved()
        return failed

    def _solve(self, eta: F64) -> F64:
        self.factor.decrease(eta, self._watch)
        return self.factor.step(self._watch)
