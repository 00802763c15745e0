"""Drives of a robot in the plane and one in space whose sensors are at places that nobody has measured well."""

from collections.abc import Iterator

import numpy as np
from naive.dense_factors import boxplus, pose_matrix
from naive.random_derived import random_derived
from naive.random_graphs import factor, random_information

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

MOUNTED = tuple(name for name, kind in FACTOR_KINDS.items() if "mount" in kind.modifiers)
PLANE_MOUNT, SPACE_MOUNT, CAMERA_MOUNT = (symbol(letter, 0) for letter in "mnk")
_PIXEL = 0.01
_NO_TURN = np.array([0, 0, 0, 0, 0, 0, 1.0])


def true_mounts() -> dict[int, tuple[str, np.ndarray]]:
    """Kind and value of each mount by its key."""
    return {
        PLANE_MOUNT: ("se2", np.array([0.4, -0.2, 0.5])),
        SPACE_MOUNT: ("se3", boxplus("se3", _NO_TURN, np.array([0.3, 0.1, 0.5, 0.2, -0.4, 0.3]))),
        CAMERA_MOUNT: ("se3", boxplus("se3", _NO_TURN, np.array([0.2, 0, 0.1, 0.05, 1.5, -0.05]))),
    }


def mount_steps(seed: int, steps: int = 8, noise: float = 0.03, loss: str = "") -> Iterator[Batch]:
    """All of these kinds occur; poses, and points that are measured, come without values, mounts with rough ones."""
    rng, mounts = np.random.default_rng(seed), true_mounts()
    truth = {key: value for key, (_, value) in mounts.items()}

    def new(kind: str, letter: str, index: int, value: np.ndarray) -> Variables:
        truth[symbol(letter, index)] = value
        return Variables(kind, np.array([symbol(letter, index)]), None)

    def rough(kind: str, key: int) -> tuple[Variables, Factors]:
        off = rng.normal(0, 0.03, 3 if kind == "se2" else 6)
        value, upper = boxplus(kind, truth[key], off)[None], np.eye(off.size)[np.triu_indices(off.size)][None]
        return Variables(kind, np.array([key]), value), Factors(f"prior_{kind}", np.array([[key]]), value, upper)

    def made(kind: str, *keys: int) -> Factors:
        z = random_derived(kind, [truth[key] for key in keys], noise, rng)
        information = random_information(FACTOR_KINDS[kind].dim, rng)
        if kind == "point_seen_mount":
            information *= _PIXEL**2
        group = Factors(kind, np.array([keys]), z[None], information[None])
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    for n in range(steps):
        x, y, l, p = (symbol(letter, n) for letter in "xylp")
        plane, space = np.zeros(3), _NO_TURN
        if n:
            plane = boxplus("se2", truth[x - 1], np.array([1.0, 0.1, rng.normal(0, 0.6)]))
            space = boxplus("se3", truth[y - 1], np.array([1, 0, 0.1, *rng.normal(0, 0.3, 3)]))
        eye = pose_matrix(space) @ pose_matrix(truth[CAMERA_MOUNT])
        variables = [new("se2", "x", n, plane), new("se3", "y", n, space)]
        variables += [new("point2", "l", n, plane[:2] + rng.uniform(1, 3, 2))]
        variables += [new("point3", "p", n, (eye @ [*rng.uniform(-0.5, 0.5, 2), rng.uniform(3, 5), 1.0])[:3])]
        factors: list[Factors] = []
        if n == 0:
            for key, (kind, _) in mounts.items():
                group, prior = rough(kind, key)
                variables.append(group)
                factors.append(prior)
            factors += [factor("prior_se2", [x], truth, noise, rng), factor("prior_se3", [y], truth, noise, rng)]
        else:
            factors += [made("between_se2_mount", x - 1, x, PLANE_MOUNT)]
            factors += [made("between_se3_mount", y, y - 1, SPACE_MOUNT)]
            factors += [factor("between_se2", [x - 1, x], truth, noise, rng)]
            factors += [factor("between_se3", [y - 1, y], truth, noise, rng)]
            factors += [made("bearing_range_se2_mount", x, l - 1, PLANE_MOUNT)]
            factors += [made("range_se2_mount", x, l - 1, PLANE_MOUNT)]
            factors += [made("landmark_se3_mount", y, p - 1, SPACE_MOUNT)]
        factors += [made("landmark_se2_mount", x, l, PLANE_MOUNT), made("landmark_se3_mount", y, p, SPACE_MOUNT)]
        factors += [made("bearing_se2_mount", x, l, PLANE_MOUNT), made("bearing_se3_mount", y, p, SPACE_MOUNT)]
        factors += [made("range_se3_mount", y, p, SPACE_MOUNT), made("point_seen_mount", y, p, CAMERA_MOUNT)]
        yield Batch(tuple(variables), tuple(factors))
