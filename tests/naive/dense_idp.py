"""Inverse-depth features with matrices, as the papers write them: the twin of the kernels.

Nothing here shares a formula with them: lenses are written forwards only and inverted by a root finder, rotations are
scipy's, Jacobians are central differences of fourth order, covariances are J P Jᵀ with everything in it.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq, root
from scipy.spatial.transform import Rotation

from factorbus.proto.camera import Camera


def radial_factor(camera: Camera, r2: float) -> float:
    """D of the two-parameter radial model at a distorted point whose distance from the centre squared is r2 mm²."""
    return 1 + camera.number("k1") * r2 + camera.number("k2") * r2**2


def pixel(camera: Camera, ray: np.ndarray) -> np.ndarray:
    """The distorted pixel of a ray in camera axes."""
    centre = np.array([camera.number("cx"), camera.number("cy")])
    if camera.model == "radial":
        return centre + _radial(camera, ray) / [camera.number("dx"), camera.number("dy")]
    focal = np.array([camera.number("fx"), camera.number("fy")])
    if camera.model == "pinhole":
        return centre + focal * ray[..., :2] / ray[..., 2:]
    if camera.model == "radtan":
        return centre + focal * radtan(camera, ray[..., :2] / ray[..., 2:])
    beside = np.linalg.norm(ray[..., :2], axis=-1, keepdims=True)
    angle = np.arctan2(beside, ray[..., 2:])
    k = [camera.number(f"k{i}") for i in (1, 2, 3, 4)]
    seen = angle + sum(k_i * angle ** (2 * i + 3) for i, k_i in enumerate(k))
    return centre + focal * ray[..., :2] * np.divide(seen, beside, out=np.zeros_like(seen), where=beside > 0)


def _radial(camera: Camera, ray: np.ndarray) -> np.ndarray:
    """Where on the sensor, mm from the centre: of each ray by a root finder."""
    undistorted = camera.number("f") * ray[..., :2] / ray[..., 2:]
    radius = np.linalg.norm(undistorted, axis=-1, keepdims=True)
    share = np.zeros_like(radius)
    for n, wanted in enumerate(radius.ravel().tolist()):
        if wanted > 0:
            share.flat[n] = _distorted(camera, wanted) / wanted
    return undistorted * share


def _distorted(camera: Camera, radius: float) -> float:
    """The distance from the centre, mm, at which a lens has what would be at that one without distortion."""

    def beyond(r: float) -> float:
        return r * radial_factor(camera, r * r) - radius

    top = radius
    while beyond(top) < 0:
        top *= 1.5
    return float(brentq(beyond, 0, top, xtol=1e-16, rtol=1e-15))


def radtan(camera: Camera, point: np.ndarray) -> np.ndarray:
    """OpenCV's documentation, term by term."""
    x, y = point[..., 0], point[..., 1]
    k1, k2, p1, p2, k3 = (camera.number(name) for name in ("k1", "k2", "p1", "p2", "k3"))
    r2 = x**2 + y**2
    scale = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return np.stack(
        [
            x * scale + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * scale + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def ray(camera: Camera, uv: np.ndarray) -> np.ndarray:
    """The ray of a distorted pixel: in closed form for the radial model, else whatever ray has this pixel."""
    if camera.model == "radial":
        size = np.array([camera.number("dx"), camera.number("dy")])
        mm = (uv - [camera.number("cx"), camera.number("cy")]) * size
        return np.append(mm * radial_factor(camera, mm @ mm) / camera.number("f"), 1.0)
    start = (uv - [camera.number("cx"), camera.number("cy")]) / [camera.number("fx"), camera.number("fy")]
    found = root(lambda xy: pixel(camera, np.append(xy, 1.0)) - uv, start, tol=1e-15)
    return np.append(found.x, 1.0)


def matrix(q: np.ndarray) -> np.ndarray:
    """Camera to world; scalar first, of any length."""
    return Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()


def feature(camera: Camera, state: np.ndarray, uv: np.ndarray, rho: float) -> np.ndarray:
    """y of a pixel."""
    h = matrix(state[3:7]) @ ray(camera, uv)
    return np.array([*state[:3], np.arctan2(h[0], h[2]), np.arctan2(-h[1], np.hypot(h[0], h[2])), rho])


def observed(camera: Camera, state: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The pixel at which a feature is seen."""
    return pixel(camera, matrix(state[3:7]).T @ ((y[:3] - state[:3]) * y[5] + direction(y)))


def direction(y: np.ndarray) -> np.ndarray:
    """m(θ, φ)."""
    theta, phi = y[..., 3], y[..., 4]
    return np.stack([np.cos(phi) * np.sin(theta), -np.sin(phi), np.cos(phi) * np.cos(theta)], axis=-1)


def point(y: np.ndarray) -> np.ndarray:
    """Where the feature is in the world."""
    return y[:3] + direction(y) / y[5]


def slope(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, h: float = 1e-3) -> np.ndarray:
    """∂function/∂at by central differences of fourth order."""
    columns = []
    for step in h * np.eye(len(at)):
        near, far = function(at + step) - function(at - step), function(at + 2 * step) - function(at - 2 * step)
        columns.append((8 * near - far) / (12 * h))
    return np.stack(columns, axis=1)


def added(P: np.ndarray, A: np.ndarray, B: np.ndarray, padd: np.ndarray) -> np.ndarray:
    """P after adding all features at once: J blkdiag(P, Padd, ..., Padd) Jᵀ."""
    m, n = len(P), len(A)
    J = np.zeros((m + 6 * n, m + 3 * n))
    J[:m, :m] = np.eye(m)
    middle = np.zeros((m + 3 * n, m + 3 * n))
    middle[:m, :m] = P
    for k in range(n):
        J[m + 6 * k : m + 6 * k + 6, :13] = A[k]
        J[m + 6 * k : m + 6 * k + 6, m + 3 * k : m + 3 * k + 3] = B[k]
        middle[m + 3 * k : m + 3 * k + 3, m + 3 * k : m + 3 * k + 3] = padd
    return J @ middle @ J.T
