"""The kinds of variables, and the conventions of the whole solver.  MATH §2.

Conventions (those of g2o):

    se2      (x, y, θ): position in metres, heading in radians, θ in [−π, π)
    se3      (x y z, qx qy qz qw): position in metres, unit quaternion, vector part first
    point2   (x, y) metres
    point3   (x, y, z) metres
    idp      (x, y, z, θ, φ, ρ): where the camera stood that saw it first, metres; azimuth and elevation of what it saw,
             radians, θ in [−π, π); inverse distance ρ, 1/metre.  The point (x, y, z) + m(θ, φ)/ρ
    vector1 … vector9   numbers of any units, in no frame

A pose x is the frame of the robot seen from the map: it takes robot coordinates to map coordinates.  Increments are
local (applied on the right), translation first, rotation in radians:

    se2   (t, θ) ⊞ (δt, δθ) = (t + R(θ) δt, wrap(θ + δθ))
    se3   (t, q) ⊞ (δt, δφ) = (t + R(q) δt, q ⊗ exp(δφ)),   δφ a rotation vector
    idp   y ⊞ δ = y + δ, θ wrapped
    point, vector   x ⊞ δ = x + δ

Residuals, and so information matrices, have the order of the measurement; the rotation part of an se3 residual is the
vector part (qx, qy, qz) of the error quaternion, its sign chosen so that qw ≥ 0.  χ² = Σ rᵀ Ω r, without a ½.
"""

from dataclasses import dataclass

from factorbus.proto import kinds as wire
from factorbus.solver.kernels.model import layout


@dataclass(frozen=True, slots=True)
class VariableKind:
    """One kind of variable: `size` numbers are stored, its tangent space has `dim`."""

    name: str
    code: int
    size: int
    dim: int

    def __str__(self) -> str:
        return self.name


VARIABLE_KINDS = {
    name: VariableKind(name, layout.VARIABLE_CODES[name], kind.size, kind.dim)
    for name, kind in wire.VARIABLE_KINDS.items()
}
VARIABLE_KIND_OF_CODE = {kind.code: kind for kind in VARIABLE_KINDS.values()}
SE2, SE3, POINT2, POINT3, IDP = (VARIABLE_KINDS[name] for name in ("se2", "se3", "point2", "point3", "idp"))
