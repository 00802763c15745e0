"""Residuals and increments written with matrices and scipy's rotations: the twin of the kernels.

Nothing here shares a formula with them: poses are homogeneous matrices, Jacobians are central differences.  The numbers
of a value or a measurement are along the last axis; axes before it are of several at once, as differences have them.
"""

import numpy as np
from naive import dense_idp, dense_imu, dense_similar
from naive.dense_derived import derived_residual, is_derived
from naive.dense_poses import (
    joined,
    length,
    motion,
    plane_rotation,
    pose_matrix,
    pose_vector,
    rotation,
    times,
    turned,
    wrapped,
)

from factorbus.proto.camera import Camera
from factorbus.proto.inertial import form_of_name

TANGENT = {"se2": 3, "se3": 6, "point2": 2, "point3": 3, "idp": 6}
TANGENT |= {f"vector{n}": n for n in range(1, 10)} | {"so3": 3, "sim3": 7}


def boxplus(kind: str, x: np.ndarray, delta: np.ndarray) -> np.ndarray:
    """x ⊞ δ for a kind of variable."""
    if kind.startswith(("point", "vector")):
        return x + delta
    if kind == "idp":
        moved = x + delta
        moved[..., 3] = wrapped(moved[..., 3])
        return moved
    if kind in ("so3", "sim3"):
        return dense_similar.boxplus(kind, x, delta)
    turn = plane_rotation(delta[..., 2]) if kind == "se2" else turned(delta[..., 3:])
    return pose_vector(pose_matrix(x) @ motion(turn, delta[..., : turn.shape[-1]]))


def residual(kind: str, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """r of a kind of factor at the values of its variables.  Raises KeyError: it has no twin yet."""
    if is_derived(kind):
        return derived_residual(residual, kind, ends, z)
    if kind.endswith(("so3", "sim3")) and not kind.startswith("linear"):
        return dense_similar.residual(kind, ends, z)
    if kind.startswith("velocity_frame"):
        return times(pose_matrix(ends[0])[..., :-1, :-1], ends[1]) - z
    if kind in ("idp_first", "idp_seen", "point_seen"):
        return _observation(kind, *ends, z)
    if kind == "length_vector3":
        return length(ends[0]) - z
    if kind.startswith("linear"):
        return _linear(kind, ends, z)
    if kind.startswith("imu"):
        return dense_imu.residual(form_of_name(kind), ends, z)
    if kind.startswith(("position", "heading", "attitude")):
        return _absolute(kind, ends[0], z)
    if kind.startswith("prior_point"):
        return ends[0] - z
    if kind.startswith("prior"):
        return _pose_error(np.linalg.inv(pose_matrix(z)) @ pose_matrix(ends[0]))
    if kind.startswith("between"):
        relative = np.linalg.inv(pose_matrix(ends[0])) @ pose_matrix(ends[1])
        return _pose_error(np.linalg.inv(pose_matrix(z)) @ relative)
    if kind.startswith("range_between"):
        a, b = (pose_matrix(end)[..., :-1, -1] for end in ends)
        return length(a - b) - z
    if kind.startswith(("landmark", "range", "bearing")):
        return _of_a_point(kind, *ends, z)
    raise KeyError(f"the kind {kind!r} has no dense twin; write its residual here")


def _of_a_point(kind: str, pose: np.ndarray, point: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of a point as a pose sees it: where, how far, in which direction."""
    seen = times(np.linalg.inv(pose_matrix(pose)), joined(point, np.ones(1)))[..., :-1]
    if kind.startswith("range"):
        return length(seen) - z
    if kind == "bearing_se3":
        return seen / length(seen) - z / length(z)
    if kind.startswith("landmark"):
        return seen - z
    turn = wrapped(np.arctan2(seen[..., 1:], seen[..., :1]) - z[..., :1])
    return turn if kind == "bearing_se2" else joined(turn, length(seen) - z[..., 1:])


def _absolute(kind: str, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of a pose in the map: where its antenna is, where it looks, how it sees a direction."""
    T = pose_matrix(x)
    n = T.shape[-1] - 1
    if kind.startswith("position"):
        return times(T, joined(z[..., n:], np.ones(1)))[..., :n] - z[..., :n]
    if kind == "heading_se2":
        return wrapped(x[..., 2:] - z)
    seen, there = z[..., :3] / length(z[..., :3]), z[..., 3:] / length(z[..., 3:])
    return times(np.swapaxes(T[..., :3, :3], -1, -2), there) - seen


def linear_ends(kind: str) -> list[str]:
    """What a linear factor of this name is of."""
    _, _, *of = kind.split("_")
    return of


def boxminus(kind: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x ⊟ y as linear factors have it."""
    if kind.startswith(("point", "vector")):
        return x - y
    if kind == "idp":
        return np.where(np.arange(6) == 3, wrapped(x - y), x - y)
    if kind in ("so3", "sim3"):
        return dense_similar.boxminus(kind, x, y)
    error = _pose_error(np.linalg.inv(pose_matrix(y)) @ pose_matrix(x))
    return error if kind == "se2" else error * np.array([1, 1, 1, 2, 2, 2])


def _linear(kind: str, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """Σ H (x ⊟ y) + b."""
    of = linear_ends(kind)
    rows, sizes = int(kind.split("_")[1]), [x.shape[-1] for x in ends]
    *ys, rest = np.split(z, np.cumsum(sizes), axis=-1)
    r = rest[..., -rows:]
    for end, x, y in zip(of, ends, ys, strict=True):
        H, rest = np.split(rest, [rows * TANGENT[end]], axis=-1)
        r = r + times(H.reshape(*H.shape[:-1], rows, TANGENT[end]), boxminus(end, x, y))
    assert rest.shape[-1] == rows
    return r


def camera_of(lens: np.ndarray) -> Camera:
    """The camera that a measurement's lens describes."""
    code, fu, fv, cx, cy, _, *more = lens.tolist()
    if code == 0:
        return Camera("radial", (fu * more[0], more[0], more[1], cx, cy, more[2], more[3]))
    return Camera(*(("radtan", (fu, fv, cx, cy, *more)) if code == 1 else ("fisheye", (fu, fv, cx, cy, *more[:4]))))


def _observation(kind: str, pose: np.ndarray, end: np.ndarray, z: np.ndarray) -> np.ndarray:
    lens, turn = z[..., 3 if kind == "idp_first" else 2 :], np.swapaxes(rotation(pose[..., 3:]), -1, -2)
    away = end[..., :3] - pose[..., :3]
    ray = away if kind == "point_seen" else away * end[..., 5:] + dense_idp.direction(end)
    off = _pixels(lens, times(turn, ray)) - z[..., :2]
    return joined(away, off, end[..., 5:] - z[..., 2:3]) if kind == "idp_first" else off


def _pixels(lens: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Of each ray the pixel that its lens has it at."""
    both = joined(lens, rays)
    flat = both.reshape(-1, both.shape[-1])
    lenses, of = np.unique(flat[:, :-3], axis=0, return_inverse=True)
    seen = np.empty((len(flat), 2))
    for n, each in enumerate(lenses):
        seen[of == n] = dense_idp.pixel(camera_of(each), flat[of == n, -3:])
    return seen.reshape(*both.shape[:-1], 2)


def _pose_error(E: np.ndarray) -> np.ndarray:
    return pose_vector(E)[..., : 3 if E.shape[-1] == 3 else 6]


def jacobians(
    kind: str, end_kinds: list[str], ends: list[np.ndarray], z: np.ndarray, h: float = 1e-5
) -> list[np.ndarray]:
    """∂r/∂x of every end by central differences of fourth order, all of them in one evaluation of the residual."""
    dims = [TANGENT[of] for of in end_kinds]
    steps, before = np.array([h, -h, 2 * h, -2 * h]), ends[0].shape[:-1]
    moved = [np.broadcast_to(x, (4, sum(dims), *x.shape)).copy() for x in ends]
    for of, x, dim, start in zip(end_kinds, moved, dims, np.cumsum([0, *dims[:-1]]), strict=True):
        delta = (steps[:, None, None] * np.eye(dim)).reshape(4, dim, *(1 for _ in before), dim)
        x[:, start : start + dim] = boxplus(of, x[:, start : start + dim], delta)
    near, back, far, far_back = residual(kind, moved, z)
    J = np.moveaxis((8 * (near - back) - (far - far_back)) / (12 * h), 0, -1)
    return np.split(J, np.cumsum(dims)[:-1], axis=-1)
