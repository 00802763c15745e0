"""Rigid motions as matrices (..., k, k), k = 3 in the plane and 4 in space, with the tangent spaces of the solver:
local increments, translation first, T ⊞ x = T exp(x), metres and radians.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64

_NO_TURN = 1e-9  # sine of an angle that has no axis any more


def motions_of_poses(values: F64) -> F64:
    """Poses x y θ, or x y z qx qy qz qw, (n, 3 or 7), as matrices."""
    n, plane = len(values), values.shape[1] == 3
    size = 3 if plane else 4
    T = np.zeros((n, size, size))
    T[:, np.arange(size), np.arange(size)] = 1.0
    if plane:
        c, s = np.cos(values[:, 2]), np.sin(values[:, 2])
        T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1] = c, -s, s, c
        T[:, :2, 2] = values[:, :2]
        return T
    v, w = values[:, 3:6], values[:, 6]
    K = np.zeros((n, 3, 3))
    K[:, 0, 1], K[:, 0, 2], K[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    K -= K.swapaxes(1, 2)
    T[:, :3, :3] += 2.0 * (w[:, None, None] * K + K @ K)
    T[:, :3, 3] = values[:, :3]
    return T


def inverse_motion(T: F64) -> F64:
    """T⁻¹."""
    out, back = np.zeros_like(T), T[..., :-1, :-1].swapaxes(-1, -2)
    out[..., :-1, :-1] = back
    out[..., :-1, -1] = -(back @ T[..., :-1, -1:])[..., 0]
    out[..., -1, -1] = 1.0
    return out


def tangent_of(T: F64) -> F64:
    """(..., d): the translation as it stands, and the rotation as a vector."""
    if T.shape[-1] == 3:
        turn = np.arctan2(T[..., 1, 0], T[..., 0, 0])[..., None]
        return np.concatenate([T[..., :2, 2], turn], axis=-1)
    R = T[..., :3, :3]
    axis = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    twice_sine = np.linalg.norm(axis, axis=-1)
    angle = np.arctan2(twice_sine, np.trace(R, axis1=-2, axis2=-1) - 1.0)
    turn = axis * np.where(twice_sine > _NO_TURN, angle / np.maximum(twice_sine, _NO_TURN), 0.5)[..., None]
    turn[..., 0] = np.where(
        (twice_sine <= _NO_TURN) & (angle > 1.0), np.pi, turn[..., 0]
    )  # half a turn, about any axis
    return np.concatenate([T[..., :3, 3], turn], axis=-1)


def adjoint_motion(T: F64) -> F64:
    """Ad (..., d, d): T exp(x) = exp(Ad x) T."""
    size = T.shape[-1] - 1
    d = 3 * (size - 1)
    out, R, t = np.zeros((*T.shape[:-2], d, d)), T[..., :size, :size], T[..., :size, size]
    out[..., :size, :size] = R
    if size == 2:
        out[..., 0, 2], out[..., 1, 2], out[..., 2, 2] = t[..., 1], -t[..., 0], 1.0
        return out
    out[..., 3:, 3:] = R
    out[..., :3, 3:] = np.cross(t[..., None, :], R.swapaxes(-1, -2)).swapaxes(-1, -2)
    return out
