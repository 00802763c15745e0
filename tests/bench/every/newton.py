"""Newton's step, for valleys in which Gauss-Newton overshoots: large residuals curve χ² more than Jacobians say."""

from collections.abc import Callable

import numpy as np
from bench.replays.columns import F64

_SIZE = 1e-5  # metres and radians, the most of a central difference
_LEFT = 1e-4  # of the decrease, where iterations end
_MOST_ITERATIONS = 100
_HALVES = 6


def newton_steps(eta: F64, eta_at: Callable[[F64], F64], solve: Callable[[F64], F64]) -> list[F64]:
    """H⁻¹ η and its halves, to be tried in turn, H the Hessian of χ² / 2 by central differences of −η.

    eta_at: η at x ⊞ δ.  solve: Λ⁻¹, the preconditioner of conjugate gradients, which end where H is not positive.
    """
    delta, g = np.zeros_like(eta), eta.copy()
    p = z = solve(eta)
    square = first = float(z @ eta)
    for _ in range(_MOST_ITERATIONS):
        size = _SIZE / np.abs(p).max()
        Hp = (eta_at(-size * p) - eta_at(size * p)) / (2 * size)
        curvature = float(p @ Hp)
        if curvature <= 0.0:
            break
        delta, g, before = delta + square / curvature * p, g - square / curvature * Hp, square
        z = solve(g)
        square = float(z @ g)
        if square <= _LEFT * first:
            break
        p = z + square / before * p
    whole = delta if delta.any() else p
    return [0.5**n * whole for n in range(_HALVES + 1)]
