"""Residuals of kinds with further variables, by matrices and their exponential: the twin of `composed`."""

from collections.abc import Callable

import numpy as np
from naive.dense_poses import joined, pose_matrix, pose_vector
from scipy.linalg import expm

MODIFIERS = ("mount", "bias", "scale", "frame", "arm", "offset", "focal", "bundler", "intrinsics")
LENSES = MODIFIERS[-3:]


def parts_of(kind: str) -> tuple[str, list[str]]:
    """The base kind, and what it is with."""
    words, modifiers = kind.split("_"), list[str]()
    while words[-1] in MODIFIERS and words[0] not in ("velocity", "imu"):
        modifiers.insert(0, words.pop())
    return "_".join(words), modifiers


def is_derived(kind: str) -> bool:
    return bool(parts_of(kind)[1])


def twist_matrix(v: np.ndarray) -> np.ndarray:
    """The generator of a motion, (3,) in the plane or (6,) in space: velocities, then angular velocities."""
    n = 2 if v.shape[-1] == 3 else 3
    xi = np.zeros((*v.shape[:-1], n + 1, n + 1))
    xi[..., :n, n] = v[..., :n]
    if n == 2:
        xi[..., 0, 1], xi[..., 1, 0] = -v[..., 2], v[..., 2]
    else:
        xi[..., :3, :3] = np.cross(np.eye(3), v[..., None, 3:])
    return xi


def base_ends(kind: str, ends: list[np.ndarray], z: np.ndarray) -> tuple[list[np.ndarray], np.ndarray]:
    """The values that the base kind has its residual at, and what it has measured."""
    _, modifiers = parts_of(kind)
    count = len(ends) - len(modifiers)
    of, width = dict(zip(modifiers, ends[count:], strict=True)), ends[0].shape[-1]
    n = 2 if width == 3 else 3
    left = right = np.eye(n + 1)
    if "mount" in of:
        right = pose_matrix(of["mount"])
    if "offset" in of:
        known = 3 if width == 3 else 6
        right = expm(twist_matrix(z[..., -known:]) * of["offset"][..., None])
        z = z[..., :-known]
    if "frame" in of:
        left = pose_matrix(of["frame"])
    if "arm" in of:
        z = joined(z, of["arm"])
    if "scale" in of:
        z = joined(z[..., :n] * of["scale"], z[..., n:])
    for lens in LENSES:
        if lens in of:
            z = joined(z[..., :2], with_lens(lens, of[lens], z[..., 2:]))
    if not {"mount", "offset", "frame"} & of.keys():
        return ends[:count], z
    moved = [pose_vector(left @ pose_matrix(x) @ right) if x.shape[-1] == width else x for x in ends[:count]]
    return moved, z


def with_lens(modifier: str, numbers: np.ndarray, lens: np.ndarray) -> np.ndarray:
    """The lens of a measurement, (code, fu, fv, cx, cy, limit, five of the model), with these numbers in it."""
    code, fu, fv, centre, limit, more = np.split(lens, [1, 2, 3, 5, 6], axis=-1)
    if modifier == "intrinsics":
        return joined(code, numbers[..., :4], limit, numbers[..., 4:])
    if modifier == "bundler":
        more = joined(numbers[..., 1:], more[..., 2:])
    focal = numbers[..., :1]
    return joined(code, focal, focal * fv / fu, centre, limit, more)


def derived_residual(
    residual: Callable[[str, list[np.ndarray], np.ndarray], np.ndarray],
    kind: str,
    ends: list[np.ndarray],
    z: np.ndarray,
) -> np.ndarray:
    """r; residual: that of the base kind."""
    base, modifiers = parts_of(kind)
    r = residual(base, *base_ends(kind, ends, z))
    return r + ends[-1] if "bias" in modifiers else r


def with_further(kind: str, z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What a kind measures where its base kind measures z: with velocities behind it, without a lever arm."""
    _, modifiers = parts_of(kind)
    n = 2 if "se2" in kind else 3
    if "arm" in modifiers:
        z = z[:-n]
    return np.concatenate([z, rng.normal(0, 0.7, 3 if n == 2 else 6)]) if "offset" in modifiers else z
