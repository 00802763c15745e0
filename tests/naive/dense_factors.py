"""Residuals and increments written with matrices and scipy's rotations, one factor at a time: the twin of the kernels.

Nothing here shares a formula with them: poses are homogeneous matrices, Jacobians are central differences.
"""

import numpy as np
from naive import dense_idp, dense_imu, dense_similar
from naive.dense_derived import derived_residual, is_derived
from naive.dense_poses import plane_rotation, pose_matrix, pose_vector
from scipy.spatial.transform import Rotation

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
        moved[3] = np.angle(np.exp(1j * moved[3]))
        return moved
    if kind in ("so3", "sim3"):
        return dense_similar.boxplus(kind, x, delta)
    n = 2 if kind == "se2" else 3
    step = np.eye(n + 1)
    step[:n, n] = delta[:n]
    step[:n, :n] = plane_rotation(delta[2]) if n == 2 else Rotation.from_rotvec(delta[3:]).as_matrix()
    return pose_vector(pose_matrix(x) @ step)


def residual(kind: str, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """r of a kind of factor at the values of its variables.  Raises KeyError: it has no twin yet."""
    if is_derived(kind):
        return derived_residual(residual, kind, ends, z)
    if kind.endswith(("so3", "sim3")) and not kind.startswith("linear"):
        return dense_similar.residual(kind, ends, z)
    if kind.startswith("velocity_frame"):
        return pose_matrix(ends[0])[:-1, :-1] @ ends[1] - z
    if kind in ("idp_first", "idp_seen", "point_seen"):
        return _observation(kind, *ends, z)
    if kind == "length_vector3":
        return np.array([np.linalg.norm(ends[0])]) - z
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
        return np.array([np.linalg.norm(np.subtract(*(pose_matrix(end)[:-1, -1] for end in ends)))]) - z
    if kind.startswith(("landmark", "range", "bearing")):
        return _of_a_point(kind, *ends, z)
    raise KeyError(f"the kind {kind!r} has no dense twin; write its residual here")


def _of_a_point(kind: str, pose: np.ndarray, point: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of a point as a pose sees it: where, how far, in which direction."""
    seen = (np.linalg.inv(pose_matrix(pose)) @ np.append(point, 1.0))[:-1]
    if kind.startswith("range"):
        return np.array([np.linalg.norm(seen)]) - z
    if kind == "bearing_se2":
        return np.array([np.angle(np.exp(1j * (np.arctan2(seen[1], seen[0]) - z[0])))])
    if kind == "bearing_se3":
        return seen / np.linalg.norm(seen) - z / np.linalg.norm(z)
    if kind == "bearing_range_se2":
        turn = np.angle(np.exp(1j * (np.arctan2(seen[1], seen[0]) - z[0])))
        return np.array([turn, np.hypot(*seen) - z[1]])
    return seen - z


def _absolute(kind: str, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Of a pose in the map: where its antenna is, where it looks, how it sees a direction."""
    T = pose_matrix(x)
    n = len(T) - 1
    if kind.startswith("position"):
        return (T @ np.append(z[n:], 1.0))[:n] - z[:n]
    if kind == "heading_se2":
        return np.array([np.angle(np.exp(1j * (x[2] - z[0])))])
    seen, there = z[:3] / np.linalg.norm(z[:3]), z[3:] / np.linalg.norm(z[3:])
    return T[:3, :3].T @ there - seen


def linear_ends(kind: str) -> list[str]:
    """What a linear factor of this name is of."""
    _, _, *of = kind.split("_")
    return of


def boxminus(kind: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x ⊟ y as linear factors have it."""
    if kind.startswith(("point", "vector")):
        return x - y
    if kind == "idp":
        return np.where(np.arange(6) == 3, np.angle(np.exp(1j * (x - y))), x - y)
    if kind in ("so3", "sim3"):
        return dense_similar.boxminus(kind, x, y)
    error = _pose_error(np.linalg.inv(pose_matrix(y)) @ pose_matrix(x))
    return error if kind == "se2" else error * np.array([1, 1, 1, 2, 2, 2])


def _linear(kind: str, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    """Σ H (x ⊟ y) + b."""
    of = linear_ends(kind)
    rows, sizes = int(kind.split("_")[1]), [len(x) for x in ends]
    *ys, rest = np.split(z, np.cumsum(sizes))
    r = rest[-rows:].copy()
    for end, x, y in zip(of, ends, ys, strict=True):
        H, rest = np.split(rest, [rows * TANGENT[end]])
        r += H.reshape(rows, TANGENT[end]) @ boxminus(end, x, y)
    assert len(rest) == rows
    return r


def camera_of(lens: np.ndarray) -> Camera:
    """The camera that a measurement's lens describes."""
    code, fu, fv, cx, cy, _, *more = lens.tolist()
    if code == 0:
        return Camera("radial", (fu * more[0], more[0], more[1], cx, cy, more[2], more[3]))
    return Camera(*(("radtan", (fu, fv, cx, cy, *more)) if code == 1 else ("fisheye", (fu, fv, cx, cy, *more[:4]))))


def _observation(kind: str, pose: np.ndarray, end: np.ndarray, z: np.ndarray) -> np.ndarray:
    camera = camera_of(z[3 if kind == "idp_first" else 2 :])
    state = np.concatenate([pose[:3], pose[[6, 3, 4, 5]], np.zeros(6)])
    if kind == "point_seen":
        return dense_idp.pixel(camera, dense_idp.matrix(state[3:7]).T @ (end - pose[:3])) - z[:2]
    off = dense_idp.observed(camera, state, end) - z[:2]
    return np.concatenate([end[:3] - pose[:3], off, [end[5] - z[2]]]) if kind == "idp_first" else off


def _pose_error(E: np.ndarray) -> np.ndarray:
    return pose_vector(E)[: 3 if len(E) == 3 else 6]


def jacobians(
    kind: str, end_kinds: list[str], ends: list[np.ndarray], z: np.ndarray, h: float = 1e-5
) -> list[np.ndarray]:
    """∂r/∂x of every end by central differences of fourth order."""
    found = []
    for e, end_kind in enumerate(end_kinds):
        columns = []
        for c in range(TANGENT[end_kind]):

            def at(t: float, e: int = e, c: int = c, end_kind: str = end_kind) -> np.ndarray:
                delta = np.zeros(TANGENT[end_kind])
                delta[c] = t
                moved = list(ends)
                moved[e] = boxplus(end_kind, ends[e], delta)
                return residual(kind, moved, z)

            columns.append((8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h))
        found.append(np.stack(columns, axis=1))
    return found
