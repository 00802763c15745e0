"""Steps that are exact where R is not: conjugate gradients on the factors, preconditioned by R.  MATH (6.4)"""

import math
from collections.abc import Callable
from functools import partial

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model.multiply_hessian import multiply_hessian
from factorbus.solver.optimize.factor import Factor
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.blocks import HessianBlocks

# By what Λ's diagonal is multiplied, less one, so that rounding leaves it positive definite: the first that does.
_DAMPINGS = (2.0**-50, 2.0**-46, 2.0**-42, 2.0**-38)
_ITERATIONS = 500  # at most
_LEFT = 1e-12  # of the decrease that was found: what is left is no more, by R


def precondition_by(factor: Factor, watch: Stopwatch, g: F64) -> tuple[float, F64]:
    """|R⁻ᵀ g|² and R⁻¹ R⁻ᵀ g."""
    square = factor.decrease(g, watch)
    return square, factor.step(watch)


def iterate(
    eta: F64,
    multiply: Callable[[F64], F64],
    precondition: Callable[[F64], tuple[float, F64]],
    left: float,
    most: int,
    floor: float = 0.0,
) -> tuple[float, F64]:
    """(δᵀη, δ) with A δ = η, until what is left is no more than a share of what was found, or `floor`; NaN where A has
    no numbers.

    multiply: A p.  precondition: gᵀ M⁻¹ g and M⁻¹ g.  Where the curvature pᵀ A p is not positive δ is what was found
    before; 0 and zeros where that is nothing.
    """
    g, x, found = eta.copy(), np.zeros(eta.size), 0.0
    square, p = precondition(g)
    if not math.isfinite(square):
        return square, p
    for _ in range(most):
        Ap = multiply(p)
        curvature = float(p @ Ap)
        if not math.isfinite(curvature):
            return math.nan, p
        if curvature <= 0.0:
            break
        size = square / curvature
        x += size * p
        g -= size * Ap
        found += size * square
        before = square
        square, z = precondition(g)
        if not square > left * found + floor:
            break
        p = z + square / before * p
    return found, x


class ConjugateGradients:
    """A `Factor` that solves by the Jacobians at the present values, and takes R of `factor` as preconditioner."""

    def __init__(self, factor: Factor) -> None:
        self._factor = factor
        self._graph: FactorGraph | None = None
        self.damped_least = False  # the least damping left R positive definite
        self._damped: F64 = np.empty(0)
        self._step: F64 = np.empty(0)

    def factorize(self, graph: FactorGraph, blocks: HessianBlocks, damping: float, watch: Stopwatch) -> int:
        """As `Factor.factorize`."""
        with np.errstate(over="ignore", invalid="ignore"):  # no pivot is good then
            self._graph, self._damped = graph, damping * blocks.data[blocks.diagonal(graph)]
        failed = -1
        for least in _DAMPINGS:
            failed = self._factor.factorize(graph, blocks, damping + least, watch)
            if failed < 0:
                self.damped_least = least == _DAMPINGS[0]
                break
        return failed

    def decrease(self, eta: F64, watch: Stopwatch) -> float:
        """δᵀη with (Λ + damping · diag Λ) δ = η; the next `step` gives this δ.  NaN where numbers do not reach."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._solve(eta, watch)

    def _solve(self, eta: F64, watch: Stopwatch) -> float:
        precondition = partial(precondition_by, self._factor, watch)
        found, self._step = iterate(eta, self._multiply, precondition, _LEFT, _ITERATIONS)
        watch.lap("solve")
        return found

    def step(self, watch: Stopwatch) -> F64:
        """The δ of the last `decrease`."""
        watch.lap("solve")
        return self._step

    def serve(self) -> bool:
        """As `Factor.serve`: never, as it has no Jacobians then."""
        return False

    def turned(self) -> None:
        """As `Factor.turned`."""
        self._factor.turned()

    def rest(self) -> None:
        """As `Factor.rest`."""
        self._factor.rest()

    def moved(self) -> None:
        """As `Factor.moved`."""
        self._factor.moved()

    def forget(self) -> None:
        """As `Factor.forget`."""
        self._factor.forget()

    def least_pivot(self) -> float:
        """As `Factor.least_pivot`."""
        return self._factor.least_pivot()

    def memory_bytes(self) -> int:
        """As `Factor.memory_bytes`."""
        return self._factor.memory_bytes() + 5 * self._damped.nbytes

    def _multiply(self, x: F64) -> F64:
        graph = self._graph
        if graph is None:
            raise ValueError("there is no factor to solve with: factorize comes first")
        out = self._damped * x
        multiply_hessian(graph.array_table, x, out)
        return out
