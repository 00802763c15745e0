"""Random graphs that grow step by step, with every kind of variable and factor in them, and single random factors."""

from collections.abc import Iterator

import numpy as np
from naive import dense_similar
from naive.dense_factors import TANGENT, boxplus, pose_matrix, pose_vector, residual
from naive.dense_idp import feature, point
from naive.dense_least_squares import CONNECTS
from naive.random_camera_factors import CAMERA_KINDS, measurement, state_of
from naive.random_cameras import CAMERAS

from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

_PIXEL = 0.01  # what a pixel is against a metre


def random_value(kind: str, rng: np.random.Generator) -> np.ndarray:
    """A value anywhere within a few metres."""
    if kind == "se2":
        return np.array([*rng.normal(0, 3, 2), rng.uniform(-np.pi, np.pi)])
    if kind == "se3":
        q = rng.normal(size=4)
        return np.concatenate([rng.normal(0, 3, 3), q / np.linalg.norm(q)])
    if kind in ("so3", "sim3"):
        pose = random_value("se3", rng)
        return pose[3:] if kind == "so3" else np.append(pose, np.exp(rng.normal(0, 0.7)))
    if kind == "idp":
        return np.array([*rng.normal(0, 3, 3), *rng.uniform(-np.pi, np.pi, 2) * [1.0, 0.4], rng.uniform(0.05, 2.0)])
    return rng.normal(0, 3, TANGENT[kind])


def random_information(dim: int, rng: np.random.Generator) -> np.ndarray:
    """The upper triangle of a full positive definite matrix."""
    J = rng.normal(size=(dim, dim))
    return (J @ J.T + dim * np.eye(dim))[np.triu_indices(dim)]


def measured(kind: str, ends: list[np.ndarray], noise: float, rng: np.random.Generator) -> np.ndarray:
    """What a factor of a kind would measure at these values, with noise."""
    if kind.endswith(("so3", "sim3")):
        return dense_similar.measured(kind, ends, noise, rng)
    if kind.startswith("prior_point"):
        return ends[0] + noise * rng.normal(size=len(ends[0]))
    if kind.startswith(("prior", "between")):
        relative = pose_matrix(ends[0])
        if len(ends) == 2:
            relative = np.linalg.inv(relative) @ pose_matrix(ends[1])
        space = CONNECTS[kind][0]
        return boxplus(space, pose_vector(relative), noise * rng.normal(size=TANGENT[space]))
    if kind in ("idp_first", "idp_seen", "point_seen"):
        z = measurement(kind, CAMERAS["radtan"], np.zeros(2), ends[1][5] if kind == "idp_first" else 0.0)
        rows = slice(3, 5) if kind == "idp_first" else slice(0, 2)
        z[:2] = residual(kind, ends, z)[rows] + noise / _PIXEL * rng.normal(size=2)
        return z
    zero = np.zeros(FACTOR_KINDS[kind].size)
    z = residual(kind, ends, zero) + noise * rng.normal(size=len(zero))
    if kind.startswith("bearing_range"):
        z[1] = abs(z[1])  # a sensor next to the point still measures a distance
    return z


def factor(kind: str, keys: list[int], truth: dict[int, np.ndarray], noise: float, rng: np.random.Generator) -> Factors:
    """One factor of a kind between known true values."""
    z = measured(kind, [truth[key] for key in keys], noise, rng)
    dim = FACTOR_KINDS[kind].dim
    information = random_information(dim, rng)
    if kind in CAMERA_KINDS:
        unit = np.array([1, 1, 1, _PIXEL, _PIXEL, 1])[:dim] if dim == 6 else np.full(2, _PIXEL)
        information *= np.outer(unit, unit)[np.triu_indices(dim)]
    return Factors(kind, np.array([keys]), z[None], information[None])


def random_steps(seed: int, steps: int = 7, noise: float = 0.03) -> Iterator[Batch]:
    """Steps of a robot in the plane and one in space that share a map; every kind occurs, and edges run both ways.

    Some variables have time stamps.
    """
    rng, clock = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    truth: dict[int, np.ndarray] = {}

    def new(kind: str, letter: str, index: int, value: np.ndarray, fixed: bool = False) -> Variables:
        truth[symbol(letter, index)] = value
        keys = np.array([symbol(letter, index)])
        stamps = clock.integers(-(2**63), 2**63, 1) if clock.random() < 0.6 else None
        return Variables(kind, keys, value[None] if fixed else None, fixed, stamps)

    def between(kind: str, i: int, j: int) -> Factors:
        keys = [i, j] if rng.random() < 0.7 else [j, i]
        return factor(kind, keys, truth, noise, rng)

    for n in range(steps):
        variables, factors = [], []
        start = random_value("se2", rng)
        if n:
            start = boxplus("se2", truth[symbol("x", n - 1)], np.array([1.0, 0.1, rng.normal(0, 0.6)]))
        variables.append(new("se2", "x", n, start, fixed=n == 0))
        if n:
            factors.append(between("between_se2", symbol("x", n - 1), symbol("x", n)))
        if n > 2 and rng.random() < 0.6:
            factors.append(between("between_se2", symbol("x", int(rng.integers(n - 2))), symbol("x", n)))
        if rng.random() < 0.5 or n == 0:
            variables.append(new("point2", "l", n, start[:2] + rng.uniform(1, 3, 2)))
            factors.append(factor("landmark_se2", [symbol("x", n), symbol("l", n)], truth, noise, rng))
            if rng.random() < 0.4:
                factors.append(factor("prior_point2", [symbol("l", n)], truth, noise, rng))
        else:
            old = [key for key in truth if key >> 56 == ord("l")]
            key = old[int(rng.integers(len(old)))]
            factors.append(factor("bearing_range_se2", [symbol("x", n), key], truth, noise, rng))
        if n and rng.random() < 0.3:
            factors.append(factor("prior_se2", [symbol("x", n)], truth, noise, rng))

        place = random_value("se3", rng)
        if n:
            place = boxplus("se3", truth[symbol("y", n - 1)], np.array([1, 0, 0.1, *rng.normal(0, 0.4, 3)]))
        variables.append(new("se3", "y", n, place))
        if n == 0:
            factors.append(factor("prior_se3", [symbol("y", 0)], truth, noise, rng))
        else:
            factors.append(between("between_se3", symbol("y", n - 1), symbol("y", n)))
        if n > 2 and rng.random() < 0.6:
            factors.append(between("between_se3", symbol("y", int(rng.integers(n - 2))), symbol("y", n)))
        if n % 2 == 0:
            variables.append(new("point3", "p", n, place[:3] + rng.uniform(1, 3, 3)))
            factors.append(factor("landmark_se3", [symbol("y", n), symbol("p", n)], truth, noise, rng))
            if rng.random() < 0.4:
                factors.append(factor("prior_point3", [symbol("p", n)], truth, noise, rng))
        else:
            factors.append(factor("landmark_se3", [symbol("y", n), symbol("p", n - 1)], truth, noise, rng))
        yield Batch(tuple(variables), tuple(factors))


def camera_steps(seed: int, steps: int = 8, noise: float = 0.03, loss: str = "") -> Iterator[Batch]:
    """Steps of a camera that goes sideways: features seen for the first time, seen again, and points seen.

    With a loss all but priors have it, and some pixels are wrong.
    """
    rng = np.random.default_rng(seed)
    truth: dict[int, np.ndarray] = {}

    def new(kind: str, letter: str, index: int, value: np.ndarray, given: bool = False) -> Variables:
        truth[symbol(letter, index)] = value
        return Variables(kind, np.array([symbol(letter, index)]), value[None] if given else None)

    def made(kind: str, *keys: int) -> Factors:
        group = factor(kind, list(keys), truth, noise, rng)
        if not loss or kind.startswith("prior"):
            return group
        if kind in ("idp_seen", "point_seen") and rng.random() < 0.15:
            group.measured[0, :2] += rng.normal(0, 20, 2) * noise / _PIXEL
        return group._replace(loss=loss, scale=np.array([1.5]))

    for n in range(steps):
        camera, last = symbol("c", n), n - 1 - (n - 1) % 4
        stand = boxplus("se3", np.array([0.3 * n, 0, 0, 0, 0, 0, 1]), 0.03 * rng.normal(size=6))
        variables = [new("se3", "c", n, stand)]
        factors = [made("between_se3", symbol("c", n - 1), camera) if n else made("prior_se3", camera)]
        for old in range(max(last, 0), last + 3):
            if symbol("f", old) in truth and rng.random() < 0.8:
                factors.append(made("idp_seen", camera, symbol("f", old)))
            if symbol("q", old) in truth and rng.random() < 0.5:
                factors.append(made("point_seen", camera, symbol("q", old)))
        if n % 4 < 2:
            y = feature(CAMERAS["radtan"], state_of(stand), rng.uniform((300, 150), (450, 350)), 0.2)
            variables += [new("idp", "f", n, y), new("point3", "q", n, point(y), given=True)]
            factors += [made("idp_first", camera, symbol("f", n)), made("point_seen", camera, symbol("q", n))]
            factors.append(made("prior_point3", symbol("q", n)))
        yield Batch(tuple(variables), tuple(factors))
