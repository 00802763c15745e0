"""Drives of a robot with cameras of whose lenses some numbers are variables, with and without a mount."""

from collections.abc import Iterator

import numpy as np
from naive.dense_derived import LENSES, parts_of
from naive.dense_factors import TANGENT, boxplus, pose_matrix, residual
from naive.random_graphs import factor, random_information

from factorbus.proto.camera import Camera
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

LENS_KINDS = tuple(name for name, kind in FACTOR_KINDS.items() if {*LENSES} & {*kind.modifiers})
# The camera as it is believed to be; fisheye and radial ones may have a focal length that is a variable.
BELIEVED = {
    "radtan": Camera("radtan", (400.0, 410.0, 320.0, 240.0, -0.2, 0.05, 0.001, -0.002, 0.01)),
    "fisheye": Camera("fisheye", (400.0, 410.0, 320.0, 240.0, 0.02, -0.01, 0.003, -0.001)),
    "radial": Camera("radial", (2.2, 0.0112, 0.0112, 162.0, 125.0, 0.063, 0.0139)),
}
MOUNT = symbol("k", 0)
KEYS = {lens: symbol("c", n) for n, lens in enumerate(LENSES)}
_NO_TURN = np.array([0, 0, 0, 0, 0, 0, 1.0])


def true_lenses() -> dict[int, tuple[str, np.ndarray]]:
    """Kind and value of the mount and of each lens by its key."""
    return {
        MOUNT: ("se3", boxplus("se3", _NO_TURN, np.array([0.2, 0, 0.1, 0.05, 0.1, -0.05]))),
        KEYS["focal"]: ("vector1", np.array([420.0])),
        KEYS["bundler"]: ("vector3", np.array([390.0, -0.15, 0.06])),
        KEYS["intrinsics"]: ("vector9", np.array([405.0, 395.0, 330.0, 230.0, -0.2, 0.08, 0.002, -0.003, 0.02])),
    }


def pixel_seen(
    kind: str, ends: list[np.ndarray], noise: float, rng: np.random.Generator, camera: str = "radtan"
) -> np.ndarray:
    """What a factor of such a kind would measure at these values, with noise in pixels."""
    lens = BELIEVED[camera].lens()
    there = residual(kind, ends, np.array([0.0, 0.0, *lens]))
    return np.array([*there + noise * rng.normal(size=2), *lens])


def random_lens_factor(kind: str, rng: np.random.Generator, camera: str) -> tuple[list[np.ndarray], np.ndarray]:
    """(values of the variables, measurement): a point before the camera."""
    pose = boxplus("se3", _NO_TURN, rng.normal(0, 0.7, 6))
    ends, eye, lens = [pose], pose_matrix(pose), parts_of(kind)[1][-1]
    if "mount" in kind:
        ends.append(boxplus("se3", _NO_TURN, rng.normal(0, 0.4, 6)))
        eye = eye @ pose_matrix(ends[1])
    ends.insert(1, (eye @ [*rng.uniform(-1, 1, 2), rng.uniform(2, 5), 1.0])[:3])
    ends.append(true_lenses()[KEYS[lens]][1] * rng.uniform(0.9, 1.1))
    if camera == "radial":
        ends[-1] *= 0.5
    return ends, pixel_seen(kind, ends, 2.0, rng, camera)


def lens_steps(seed: int, steps: int = 6, noise: float = 0.5, loss: str = "") -> Iterator[Batch]:
    """All of these kinds occur; poses and points come without values, lenses and the mount with rough ones."""
    rng, hidden = np.random.default_rng(seed), true_lenses()
    truth = {key: value for key, (_, value) in hidden.items()}
    spread = {
        "vector1": np.array([20.0]),
        "vector3": np.array([20, 0.05, 0.02]),
        "vector9": np.array([20, 20, 5, 5, 0.05, 0.02, 0.002, 0.002, 0.01]),
    }

    def new(kind: str, letter: str, index: int, value: np.ndarray) -> Variables:
        truth[symbol(letter, index)] = value
        return Variables(kind, np.array([symbol(letter, index)]), None)

    def rough(kind: str, key: int) -> tuple[Variables, Factors]:
        dim = TANGENT[kind]
        sigmas = spread.get(kind, np.full(dim, 0.03))
        value = boxplus(kind, truth[key], 0.5 * sigmas * rng.normal(size=dim))[None]
        if kind == "se3":
            upper = np.eye(6)[np.triu_indices(6)][None]
            return Variables(kind, np.array([key]), value), Factors("prior_se3", np.array([[key]]), value, upper)
        upper = np.diag(sigmas**-2.0)[np.triu_indices(dim)][None]
        z = np.concatenate([value, np.eye(dim).reshape(1, -1), np.zeros((1, dim))], axis=1)
        return Variables(kind, np.array([key]), value), Factors(f"linear_{dim}_{kind}", np.array([[key]]), z, upper)

    def seen(kind: str, *keys: int) -> Factors:
        z = pixel_seen(kind, [truth[key] for key in keys], noise, rng)
        group = Factors(kind, np.array([keys]), z[None], 4.0 * random_information(2, rng)[None])
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    for n in range(steps):
        y, p, q = (symbol(letter, n) for letter in "ypq")
        space = _NO_TURN if n == 0 else boxplus("se3", truth[y - 1], np.array([0.8, 0, 0.1, *rng.normal(0, 0.15, 3)]))
        variables, factors = [new("se3", "y", n, space)], list[Factors]()
        if n == 0:
            for key, (kind, _) in hidden.items():
                group, prior = rough(kind, key)
                variables.append(group)
                factors.append(prior)
            factors.append(factor("prior_se3", [y], truth, 0.01, rng))
        else:
            factors.append(factor("between_se3", [y - 1, y], truth, 0.01, rng))
        for letter in "pq":
            ahead = boxplus("se3", space, np.array([*rng.uniform(-1.5, 1.5, 2), rng.uniform(4, 6), 0, 0, 0]))[:3]
            variables.append(new("point3", letter, n, ahead))
            factors.append(factor("landmark_se3", [y, symbol(letter, n)], truth, 0.05, rng))
        for point in (p, q) if n == 0 else (p, q, p - 1):
            for kind in LENS_KINDS:
                ends = [y, point, *([MOUNT] if "mount" in kind else []), KEYS[parts_of(kind)[1][-1]]]
                factors.append(seen(kind, *ends))
        yield Batch(tuple(variables), tuple(factors))
