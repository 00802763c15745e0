"""Rotations and similarities as matrices, (3, 3) and (4, 4) with s R in them: the twin of `similarity`."""

import numpy as np
from naive.dense_poses import joined, length, motion, quaternion, rotation, times, turned


def matrix(kind: str, x: np.ndarray) -> np.ndarray:
    if kind == "so3":
        return rotation(x)
    return motion(x[..., 7, None, None] * rotation(x[..., 3:7]), x[..., :3])


def value(kind: str, M: np.ndarray) -> np.ndarray:
    """With w ≥ 0."""
    s = np.cbrt(np.linalg.det(M[..., :3, :3]))[..., None]
    q = quaternion(M[..., :3, :3] / s[..., None])
    return q if kind == "so3" else joined(M[..., :3, 3], q, s)


def boxplus(kind: str, x: np.ndarray, delta: np.ndarray) -> np.ndarray:
    if kind == "so3":
        return value(kind, matrix(kind, x) @ turned(delta))
    step = motion(np.exp(delta[..., 6, None, None]) * turned(delta[..., 3:6]), delta[..., :3])
    return value(kind, matrix(kind, x) @ step)


def error(kind: str, M: np.ndarray) -> np.ndarray:
    """Of z⁻¹ ∘ x: its quaternion's vector part; of a similarity behind where it is, and before ln s."""
    x = value(kind, M)
    return x[..., :3] if kind == "so3" else joined(x[..., :6], np.log(x[..., 7:]))


def boxminus(kind: str, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    left = error(kind, np.linalg.inv(matrix(kind, y)) @ matrix(kind, x))
    return 2 * left if kind == "so3" else left * [1, 1, 1, 2, 2, 2, 1]


def residual(kind: str, ends: list[np.ndarray], z: np.ndarray) -> np.ndarray:
    of = kind.split("_")[1]
    M = matrix(of, ends[0])
    if kind.startswith("prior"):
        return error(of, np.linalg.inv(matrix(of, z)) @ M)
    if kind.startswith("between"):
        return error(of, np.linalg.inv(M @ matrix(of, z)) @ matrix(of, ends[1]))
    if kind == "attitude_so3":
        return times(np.swapaxes(M, -1, -2), z[..., 3:] / length(z[..., 3:])) - z[..., :3] / length(z[..., :3])
    if kind == "position_sim3":
        return ends[0][..., :3] - z
    return times(np.linalg.inv(M), joined(ends[1], np.ones(1)))[..., :3] - z


def measured(kind: str, ends: list[np.ndarray], noise: float, rng: np.random.Generator) -> np.ndarray:
    """What a factor of such a kind would measure at these values, with noise."""
    of = kind.split("_")[1]
    if kind.startswith(("prior", "between")):
        M = matrix(of, ends[0])
        if len(ends) == 2:
            M = np.linalg.inv(M) @ matrix(of, ends[1])
        return boxplus(of, value(of, M), noise * rng.normal(size=3 if of == "so3" else 7))
    if kind == "attitude_so3":
        there = rng.normal(size=3)
        seen = matrix(of, ends[0]).T @ there / np.linalg.norm(there) + noise * rng.normal(size=3)
        return np.concatenate([2.0 * seen, there])
    return residual(kind, ends, np.zeros(3)) + noise * rng.normal(size=3)
