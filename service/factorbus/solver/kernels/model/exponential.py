"""The motion of a body whose velocities stay as they are in its own frame, for a time.  MATH §3.9.

Exp(ξ δ) with ξ = (v, ω): a way along a circle, or a screw in space.  With α = |ω δ|, b = (1 − cos α)/α² and
c = (α − sin α)/α³ its translation is (I + b ⌊ω δ⌋ + c ⌊ω δ⌋²) v δ, and its rotation that by ω δ.         (3.39)
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model.se2 import wrap
from factorbus.solver.kernels.model.se3 import half_turn

# Below this angle the series of b and c are exact to the last digits, and the quotients are not.
_SMALL = 1e-3


@inline_kernel
def quotients(alpha: float) -> tuple:
    """(b, c) of an angle α ≥ 0."""
    square = alpha * alpha
    if alpha < _SMALL:
        return 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    return (1.0 - math.cos(alpha)) / square, (alpha - math.sin(alpha)) / (square * alpha)


@part
def exp_se2(p: F64, k: int, delta: float, y: F64, to: int) -> None:
    """The pose (x, y, θ) at y[to] := Exp(ξ δ), ξ = (v_x, v_y, ω) at p[k], δ in seconds."""
    ux, uy, turn = delta * p[k], delta * p[k + 1], delta * p[k + 2]
    b, c = quotients(abs(turn))
    along, across = 1.0 - c * turn * turn, b * turn
    y[to], y[to + 1], y[to + 2] = along * ux - across * uy, across * ux + along * uy, wrap(turn)


@part
def exp_se3(p: F64, k: int, delta: float, y: F64, to: int) -> None:
    """The pose (x y z, qx qy qz qw) at y[to] := Exp(ξ δ), ξ = (v, ω) at p[k], δ in seconds."""
    u0, u1, u2 = delta * p[k], delta * p[k + 1], delta * p[k + 2]
    f0, f1, f2 = delta * p[k + 3], delta * p[k + 4], delta * p[k + 5]
    alpha = math.sqrt(f0 * f0 + f1 * f1 + f2 * f2)
    b, c = quotients(alpha)
    g0, g1, g2 = f1 * u2 - f2 * u1, f2 * u0 - f0 * u2, f0 * u1 - f1 * u0
    y[to] = u0 + b * g0 + c * (f1 * g2 - f2 * g1)
    y[to + 1] = u1 + b * g1 + c * (f2 * g0 - f0 * g2)
    y[to + 2] = u2 + b * g2 + c * (f0 * g1 - f1 * g0)
    half, cosine = half_turn(alpha * alpha)
    y[to + 3], y[to + 4], y[to + 5], y[to + 6] = half * f0, half * f1, half * f2, cosine
