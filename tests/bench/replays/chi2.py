"""χ² = Σ rᵀΩr in g2o's convention, in plain numpy: one judge for the estimates of every solver.

between_se2    r = (Rzᵀ(Rᵢᵀ(tⱼ − tᵢ) − tz), wrap(θⱼ − θᵢ − θz))
between_se3    translation likewise; then the vector part of qz⁻¹qᵢ⁻¹qⱼ with its sign such that qw ≥ 0
landmark       r = Rᵢᵀ(l − tᵢ) − z
bearing_range  r = (wrap(atan2(u_y, u_x) − z₀), |u| − z₁),   u = Rᵢᵀ(l − tᵢ)
prior          as between_se2 and between_se3 with the identity as xᵢ
position       r = tᵢ + Rᵢ l − z, where z ends with the lever l; position_frame: of the pose xⱼ ∘ xᵢ
range          r = |l − tᵢ| − z

A ratio is χ² over that of an optimum.  Where the optimum is below `UNIT` an excess is taken as it is, not as a share:
before the first loop an optimum is 0 but for rounding, and data sets whose measurements agree (killian: 5.8e-8) stay
there.  An excess of 0.001 moves nothing by more than √0.001 = 0.032 of its standard deviations.
"""

from collections.abc import Callable

import numpy as np

from .columns import ENDS, F64, Columns, Values

UNIT = 1.0


def ratio(chi2: float, optimum: float) -> float:
    """χ² over that of an optimum."""
    return 1.0 + (chi2 - optimum) / max(optimum, UNIT)


def chi2_at(columns: Columns, values: Values, step: int) -> float:
    """χ² of all factors of steps 0 .. step at `values`.  Raises ValueError when a value that they need is missing."""
    tables, total = columns.table(values), 0.0
    for group in columns.factors:
        i, j, z, information = group.up_to(step)
        a, b = ENDS[group.kind]
        r = RESIDUALS[group.kind](tables[a][i], tables[b][j], z)
        total += float(np.einsum("mi,mij,mj->", r, information, r, optimize=True))
    if np.isnan(total):
        raise ValueError(f"the estimate after step {step} has no value, or no number, for a variable that is in")
    return total


def wrap(angle: F64) -> F64:
    """Into [−π, π)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def into_frame_2d(pose: F64, point: F64) -> F64:
    """Rᵀ(p − t): points (m, 2) as seen from poses (m, 3)."""
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    d = point - pose[:, :2]
    return np.stack((c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]), axis=1)


def _between_se2(a: F64, b: F64, z: F64) -> F64:
    t = into_frame_2d(z, into_frame_2d(a, b[:, :2]))
    return np.concatenate((t, wrap(b[:, 2] - a[:, 2] - z[:, 2])[:, None]), axis=1)


def _landmark_se2(a: F64, b: F64, z: F64) -> F64:
    return into_frame_2d(a, b) - z


def _bearing_range_se2(a: F64, b: F64, z: F64) -> F64:
    u = into_frame_2d(a, b)
    return np.stack((wrap(np.arctan2(u[:, 1], u[:, 0]) - z[:, 0]), np.hypot(u[:, 0], u[:, 1]) - z[:, 1]), axis=1)


def _bearing_se2(a: F64, b: F64, z: F64) -> F64:
    u = into_frame_2d(a, b)
    return wrap(np.arctan2(u[:, 1], u[:, 0])[:, None] - z)


def _between_se3(a: F64, b: F64, z: F64) -> F64:
    t = into_frame_3d(z, into_frame_3d(a, b[:, :3]))
    q = _times(_conjugate(z[:, 3:]), _times(_conjugate(a[:, 3:]), b[:, 3:]))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return np.concatenate((t, np.where(q[:, 3:] < 0, -q[:, :3], q[:, :3])), axis=1)


def _landmark_se3(a: F64, b: F64, z: F64) -> F64:
    return into_frame_3d(a, b) - z


def into_frame_3d(pose: F64, point: F64) -> F64:
    """Rᵀ(p − t): points (m, 3) as seen from poses (m, 7), quaternions (x y z w)."""
    q = pose[:, 3:] / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
    v, d = -q[:, :3], point - pose[:, :3]
    twice = 2 * np.cross(v, d)
    return d + q[:, 3:] * twice + np.cross(v, twice)


def _conjugate(q: F64) -> F64:
    return q * np.array([-1.0, -1.0, -1.0, 1.0])


def _times(p: F64, q: F64) -> F64:
    v = p[:, 3:] * q[:, :3] + q[:, 3:] * p[:, :3] + np.cross(p[:, :3], q[:, :3])
    w = p[:, 3:] * q[:, 3:] - (p[:, :3] * q[:, :3]).sum(axis=1, keepdims=True)
    return np.concatenate((v, w), axis=1)


def _prior_se2(a: F64, _: F64, z: F64) -> F64:
    return _between_se2(np.zeros_like(a), a, z)


def _prior_se3(a: F64, _: F64, z: F64) -> F64:
    return _between_se3(np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(a), 1)), a, z)


def _position_se2(a: F64, _: F64, z: F64) -> F64:
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    lever = np.stack((c * z[:, 2] - s * z[:, 3], s * z[:, 2] + c * z[:, 3]), axis=1)
    return a[:, :2] + lever - z[:, :2]


def _position_se3(a: F64, _: F64, z: F64) -> F64:
    back = np.concatenate((np.zeros((len(a), 3)), _conjugate(a[:, 3:])), axis=1)
    return a[:, :3] + into_frame_3d(back, z[:, 3:]) - z[:, :3]


def _position_se2_frame(a: F64, f: F64, z: F64) -> F64:
    c, s = np.cos(f[:, 2]), np.sin(f[:, 2])
    x, y = f[:, 0] + c * a[:, 0] - s * a[:, 1], f[:, 1] + s * a[:, 0] + c * a[:, 1]
    return _position_se2(np.stack((x, y, f[:, 2] + a[:, 2]), axis=1), a, z)


def _position_se3_frame(a: F64, f: F64, z: F64) -> F64:
    back = np.concatenate((np.zeros((len(f), 3)), _conjugate(f[:, 3:])), axis=1)
    there = np.concatenate((f[:, :3] + into_frame_3d(back, a[:, :3]), _times(f[:, 3:], a[:, 3:])), axis=1)
    return _position_se3(there, a, z)


def _range_se2(a: F64, b: F64, z: F64) -> F64:
    return np.linalg.norm(b - a[:, :2], axis=1)[:, None] - z


def _range_se3(a: F64, b: F64, z: F64) -> F64:
    return np.linalg.norm(b - a[:, :3], axis=1)[:, None] - z


RESIDUALS: dict[str, Callable[[F64, F64, F64], F64]] = {
    "between_se2": _between_se2,
    "between_se3": _between_se3,
    "landmark_se2": _landmark_se2,
    "landmark_se3": _landmark_se3,
    "bearing_range_se2": _bearing_range_se2,
    "bearing_se2": _bearing_se2,
    "prior_se2": _prior_se2,
    "prior_se3": _prior_se3,
    "position_se2": _position_se2,
    "position_se3": _position_se3,
    "position_se2_frame": _position_se2_frame,
    "position_se3_frame": _position_se3_frame,
    "range_se2": _range_se2,
    "range_se3": _range_se3,
}
