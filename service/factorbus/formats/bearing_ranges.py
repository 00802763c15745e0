"""A direction and a distance to a point, in space, as a position in the frame of the pose; and the other way.

JRL has GTSAM's terms: of a direction n, of unit length, and a distance ρ the error is where the two are off, in radians
along b₁ and b₂ and in metres along n.  So near what was measured

    u = ρ n,   J = ∂u = [ ρ b₁ | ρ b₂ | n ],   Σ_u = J Σ Jᵀ,   J⁻¹ = [ b₁/ρ | b₂/ρ | n ]ᵀ

with b₁ ∥ n × e, e the axis that n has least of, the first of equals, and b₂ = n × b₁.  That is exact to first order in
how far off a direction is: χ² of one that is off by θ differs by a share of about θ.  (GTSAM takes the axes of the
direction that it predicts, which are others where n has as much of two axes, and n is that exactly.)
"""

import numpy as np

from factorbus.proto.arrays import F64


def positions_of_bearings(measured: F64, covariance: F64) -> tuple[F64, F64]:
    """(u (n, 3), its covariance (n, 3, 3)) of n and ρ (n, 4), n of unit length, and their covariance (n, 3, 3)."""
    n, distance = measured[:, :3], measured[:, 3:]
    J = _axes(n) * np.concatenate([distance, distance, np.ones_like(distance)], axis=1)[:, None, :]
    carried = J @ covariance @ np.swapaxes(J, 1, 2)
    return n * distance, carried


def bearings_of_positions(positions: F64, covariance: F64) -> tuple[F64, F64]:
    """The inverse.  positions (n, 3): none of them 0."""
    distance = np.linalg.norm(positions, axis=1, keepdims=True)
    n = positions / distance
    back = (
        np.swapaxes(_axes(n), 1, 2) / np.concatenate([distance, distance, np.ones_like(distance)], axis=1)[:, :, None]
    )
    return np.concatenate([n, distance], axis=1), back @ covariance @ np.swapaxes(back, 1, 2)


def _axes(n: F64) -> F64:
    """[ b₁ | b₂ | n ], (n, 3, 3)."""
    least = np.eye(3)[np.abs(n).argmin(axis=1)]
    first: F64 = np.cross(n, least)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second: F64 = np.cross(n, first)
    return np.stack([first, second, n], axis=2)
