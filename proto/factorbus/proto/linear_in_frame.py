"""What linear factors say of where their variables are in the frame of the map: their numbers tell.

A small motion of the whole frame, ξ = (translation, rotation), moves x_n ⊟ y_n by G_n ξ, and so the residual by M ξ,
M = Σ H_n G_n.  Where M is zero the factor is relative: it says the same wherever its variables are together.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.linear import Parts, parts_of
from factorbus.proto.messages import Factors
from factorbus.proto.roles import AXES, FRAME, MOUNT

# Of numbers that cancel: what a factor of a solver's own making differs from zero by.
_ROUNDING = 1e-6


class SaidOfFrame(NamedTuple):
    """Of n linear factors what they say of the map's frame.

    anything (n,): M is not zero.  place (n,): more than which way is up, which a part knows of an IMU as well, and is
    no place: of a frame in space a translation, or all of its rotation; in the plane anything.
    """

    anything: np.ndarray
    place: np.ndarray


def said_of_frame(group: Factors, roles: Sequence[Sequence[str]]) -> SaidOfFrame:
    """roles: of each of the ends the role of its variable (`factorbus.proto.roles`) in each of the factors."""
    parts, count = parts_of(group.kind, group.measured), len(group.keys)
    said = SaidOfFrame(np.zeros(count, bool), np.zeros(count, bool))
    for n in range(count):
        moved = _parts_of_motion(parts, n, [of[n] for of in roles])
        if moved is None:
            continue
        M, size = np.asarray(sum(moved)), np.abs(moved).max((0, 1))
        said.anything[n] = np.abs(M).max() > _ROUNDING * max(size.max(), 1e-300)
        said.place[n] = said.anything[n] and (M.shape[1] == 3 or _holds_place(M, size))
    return said


def _parts_of_motion(parts: Parts, n: int, roles: Sequence[str]) -> list[F64] | None:
    """H_k G_k of each end that moves with the frame; None: it is on no place, but on velocities alone, say."""
    ends = list(zip(parts.kinds, roles, parts.y, parts.H, strict=True))
    if all(role == AXES or not moves_with_frame(kind, role) for kind, role, _, _ in ends):
        return None  # velocities are as certain in any frame
    return [H[n] @ _carried(kind, y[n], role) for kind, role, y, H in ends if moves_with_frame(kind, role)]


def _holds_place(M: F64, size: F64) -> bool:
    """In space.  size (6,): of the numbers that add up to each column."""
    translation, rotation = M[:, :3], M[:, 3:]
    if np.abs(translation).max() > _ROUNDING * size[:3].max():
        return True
    known = np.linalg.svd(rotation, compute_uv=False)
    return known.size == 3 and bool(known[2] > _ROUNDING * size[3:].max())


def moves_with_frame(kind: str, role: str) -> bool:
    """Whether a variable of that kind and role changes as the frame moves."""
    return role == AXES or not (role == MOUNT or VARIABLE_KINDS[kind].is_vector)


def _carried(kind: str, y: F64, role: str) -> F64:
    """G: the increment of a value when the frame that it is in moves by ξ = (translation, rotation)."""
    if role == FRAME:
        return -np.eye(VARIABLE_KINDS[kind].dim)
    if role == AXES:
        turn = np.array([[-y[1]], [y[0]]]) if y.size == 2 else -_cross(y)
        return np.column_stack([np.zeros((y.size, y.size)), turn])
    if kind == "point2":
        return np.array([[1.0, 0.0, -y[1]], [0.0, 1.0, y[0]]])
    if kind == "se2":
        R = rotation_of(y)
        return np.block([[R.T, (R.T @ [-y[1], y[0]])[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]])
    if kind == "so3":
        return np.column_stack([np.zeros((3, 3)), rotation_of(np.concatenate([np.zeros(3), y])).T])
    if kind == "sim3":
        R, moved = rotation_of(y[:7]), np.column_stack([np.eye(3), -_cross(y[:3])])
        return np.concatenate([R.T @ moved / y[7], np.column_stack([np.zeros((3, 3)), R.T]), np.zeros((1, 6))])
    moved = np.column_stack([np.eye(3), -_cross(y)])
    if kind == "point3":
        return moved
    if kind == "idp":
        turn = np.column_stack([np.zeros((2, 3)), -angles_by_ray(y) @ _cross(ray_of(y)[0])])
        return np.concatenate([moved, turn, np.zeros((1, 6))])
    R = rotation_of(y)
    return np.concatenate([R.T @ moved, np.column_stack([np.zeros((3, 3)), R.T])])


def rotation_of(pose: F64) -> F64:
    """R of a pose, (2, 2) or (3, 3)."""
    if pose.size == 3:
        c, s = np.cos(pose[2]), np.sin(pose[2])
        return np.array([[c, -s], [s, c]])
    x, y, z, w = pose[3:] / np.linalg.norm(pose[3:])
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def ray_of(y: F64) -> tuple[F64, F64]:
    """(the direction m of a feature, its Jacobian (3, 2) by θ and φ)."""
    (s, t), (c, d) = np.sin(y[3:5]), np.cos(y[3:5])
    return np.array([d * s, -t, d * c]), np.array([[d * c, -t * s], [0.0, -d], [-d * s, -t * c]])


def angles_by_ray(y: F64) -> F64:
    """The Jacobian (2, 3) of θ and φ by the direction."""
    x, _, z = ray_of(y)[0]
    flat = x * x + z * z
    return np.array([[z / flat, 0.0, -x / flat], [0.0, -1.0 / np.sqrt(flat), 0.0]])


def _cross(v: F64) -> F64:
    """⌊v⌋"""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])
