"""The linearization error of a factor: what its linear model misses between two points.  MATH §9.6.

What a pose i sees of j at a distance d is u = Rᵢᵀ (tⱼ − tᵢ), and between factors and observations of landmarks are
linear in it.  With a turn of i by φ, and shifts sᵢ and sⱼ in the map's frame, the linear model misses, to second order,

    lever error = √ω (½ d φ² + φ |sⱼ − sᵢ|)                                                              (9.4)

standard deviations at most, ω the largest diagonal entry of Ω for the translation.  Moving the linearization point of i
alone makes it zero.  A common shift adds no error, however long.  Between poses this says who moves; what counts is
exact, (9.33) in `missed_residual`.  For a bearing and a range the shift counts as well,

    lever error = √ω (½ d φ² + φ |sⱼ − sᵢ| + |sⱼ − sᵢ|² / d),      √ω = √ω_range + √ω_bearing / d        (9.5)

and both ends have to move.  A landmark never turns, so nothing above ever moves it; but where it is shifted
against the pose, the Jacobian of the pose's turn is off by that share of d, and with it the gradient, whatever φ is:

    shift error = (√ω |r| + √ω |sⱼ − sᵢ|) |sⱼ − sᵢ| / d                                                  (9.12)

r being the residual at the linearization point.  Between two poses, with the residual r(x) at the estimate, and s the
shift of j as seen from i,

    shift error = √ω |r(x)| |s| / √(d² + ω_θ/ω)                                                          (9.13)

As a bound it counts in full.  But errors of the gradient largely cancel along a path, so for what is relinearized as
the drive goes on LINKS of it counts.  Where the shift error is more than the lever error, both ends move.

Angles of the plane add up; turns in space do not.  With ψ the turn of j as seen from i since both were linearized, and
φ that of i, the vector part of the residual is off by at most

    √ω_θ ψ (½ φ + ψ² / 24)                                                                               (9.26)

ω_θ being the information of the angle: in the Hessian of j, as a residual counts half of it.  And the force √Ω r(x)
turns with j as seen from i, by which the gradient is off:

    ψ |√Ω r(x)|                                                                                          (9.30)

That counts as a bound only.  The error of an observation of a camera, and of a factor with a loss, includes that of
the weight w; it is computed: what the linear model misses of √w r, in standard deviations,

    |C (√w r(x) − √w₀ (r(x₀) + A δᵢ + B δⱼ))|,   CᵀC = Ω                                                 (9.11)

and both ends move.  As a bound the force counts as well, (9.31) in `exact_error`.
"""

import math

from factorbus.solver.kernels.jit.compile import F64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import is_camera, lens_at
from factorbus.solver.lenses.layout import FU

LINKS = 0.1
# The share of the error of an observation of a landmark that counts.  With all of it Σ error² came to 4 to 5 times the
# excess of χ² where landmarks are seen, and to 1 to 2 times between poses.
SEEN = 0.45


@inline_kernel
def turn_of(kind: int, delta: F64, d: int) -> float:
    """The angle by which δ at offset d turns a pose; 0 of a point."""
    if kind == at.SE2:
        return abs(delta[d + 2])
    if kind == at.SE3:
        a, b, c = delta[d + 3], delta[d + 4], delta[d + 5]
        return math.sqrt(a * a + b * b + c * c)
    return 0.0


@inline_kernel
def shift_between(planar: bool, x: int, y: int, values: F64, lin: F64) -> float:
    """|sⱼ − sᵢ| of the values at offsets x and y."""
    total = 0.0
    for a in range(2 if planar else 3):
        gap = values[y + a] - lin[y + a] - (values[x + a] - lin[x + a])
        total += gap * gap
    return math.sqrt(total)


@inline_kernel
def lever_error_of(root: float, d: float, phi: float, shift: float) -> float:
    """(9.4)"""
    return root * (0.5 * d * phi * phi + phi * shift)


@part
def add_observation(
    kind: int, lever_error: float, root: float, d: float, shift: float, gradient: float
) -> tuple[float, float]:  # fmt: skip
    """The lever error, with what (9.5) has beside (9.4), and the shift error (9.12) of an observation of a landmark,
    with √ω |r| as |Ω r| / √ω; gradient is |Ω r|.  Of all other kinds the lever error, and 0.
    """
    if d > 0.0:
        if kind == at.BEARING_RANGE_SE2:
            return lever_error + root * shift * shift / d, 0.0
        if kind == at.LANDMARK_SE2 or kind == at.LANDMARK_SE3:
            return lever_error, (gradient / root + root * shift) * shift / d
    return lever_error, 0.0


@inline_kernel
def shift_error_weight(root: float, d: float, turn_information: float) -> float:
    """√ω / √(d² + ω_θ/ω) of poses: times |r(x)| and |sⱼ − sᵢ| it is (9.13)."""
    return root / math.sqrt(d * d + turn_information / (root * root)) if root > 0.0 else 0.0


@inline_kernel
def turn_error(phi: float, psi: float, turn_information: float) -> float:
    """(9.26), the first pose turned by phi; turn_information is ω_θ of the angle."""
    return math.sqrt(turn_information) * psi * (0.5 * phi + psi * psi / 24.0)


@inline_kernel
def lever_of(kind: int, p: F64, k: int) -> float:
    """d: the distance at which a factor sees something; its measurement is at offset k of the payload."""
    if kind == at.BETWEEN_SE2 or kind == at.LANDMARK_SE2:
        return math.sqrt(p[k] * p[k] + p[k + 1] * p[k + 1])
    if kind == at.BETWEEN_SE3 or kind == at.LANDMARK_SE3:
        return math.sqrt(p[k] * p[k] + p[k + 1] * p[k + 1] + p[k + 2] * p[k + 2])
    if kind == at.BEARING_RANGE_SE2:
        return p[k + 1]
    if is_camera(kind):  # of a pixel: how many a radian has
        return float(p[k + lens_at(kind) + 1 + FU])
    return 0.0


@inline_kernel
def root_weight(kind: int, w: F64, d: float) -> float:
    """√ω of (9.4); 0 of a prior: in the plane it is linear, and in space (9.11) is computed."""
    if kind == at.BEARING_RANGE_SE2:
        return math.sqrt(w[1, 1]) + math.sqrt(w[0, 0]) / d
    if kind == at.BETWEEN_SE2 or kind == at.LANDMARK_SE2:
        return math.sqrt(max(w[0, 0], w[1, 1]))
    if kind == at.BETWEEN_SE3 or kind == at.LANDMARK_SE3:
        return math.sqrt(max(w[0, 0], w[1, 1], w[2, 2]))
    if is_camera(kind):
        a = 3 if kind == at.IDP_FIRST else 0
        return math.sqrt(max(w[a, a], w[a + 1, a + 1]))
    return 0.0
