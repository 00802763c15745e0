"""Drives in the plane that contradict themselves: wrong values and closures, half turns, links as stiff as 1e-6 m,
points that only ranges and bearings see, and weak priors."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables

_LOSSES = ("", "huber", "cauchy", "geman-mcclure", "tukey", "dcs")


class _World:
    """What is true, and how wrong values and measurements are."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.stiff = 10.0 ** rng.uniform(-6, -1) if rng.random() < 0.3 else 0.1  # metres and radians
        self.weak = 10.0 ** rng.uniform(-6, 1)  # of the first prior
        self.wrong = rng.choice([0.1, 1.0, np.pi])  # of values, metres and radians
        self.poses = np.zeros((int(rng.integers(3, 14)), 3))
        for i in range(1, len(self.poses)):
            self.poses[i] = _composed(self.poses[i - 1], (rng.uniform(0.5, 2), 0.0, rng.normal(0, 0.8)))
        self.points = rng.normal(0, 4, (int(rng.integers(1, 5)), 2)) + self.poses[:, :2].mean(0)
        self.anchored, self.seen = rng.random() < 0.5, set[int]()

    def loss(self, share: float) -> dict:
        name = str(self.rng.choice(_LOSSES)) if self.rng.random() < share else ""
        return {"loss": name, "scale": np.array([self.rng.uniform(0.5, 3)])} if name else {}


def contradicting_steps(seed: int) -> Iterator[Batch]:
    """A pose, and what it sees, in each."""
    world = _World(np.random.default_rng([seed, 77]))
    rng, poses = world.rng, world.poses
    for i, pose in enumerate(poses):
        variables = [Variables("se2", np.array([i]), (pose + rng.normal(0, world.wrong, 3))[None])]
        factors = [_prior(0, pose + rng.normal(0, 1, 3), world.weak) if i == 0 else _link(world, i - 1, i, world.stiff)]
        if i > 2 and rng.random() < 0.3:
            j = int(rng.integers(0, i - 1))
            off = np.array([3, -2, np.pi]) if rng.random() < 0.3 else np.zeros(3)
            factors.append(_link(world, j, i, 0.1, off, **world.loss(5 / 6)))
        for k in np.flatnonzero(rng.random(len(world.points)) < 0.7):
            _see(world, i, int(k), variables, factors)
        if rng.random() < 0.15:
            factors.append(_prior(i, pose + np.array([0, 0, rng.choice([0, np.pi])]), 1.0, 1e-3))
        yield Batch(tuple(variables), tuple(factors))


def _see(world: _World, i: int, k: int, variables: list[Variables], factors: list[Factors]) -> None:
    """A range or a bearing to point k, which comes with a weak prior, or fixed."""
    rng, key, point = world.rng, 1000 + k, world.points[k]
    if key not in world.seen:
        world.seen.add(key)
        fixed = bool(world.anchored and k % 2 == 0)
        variables.append(Variables("point2", np.array([key]), (point + rng.normal(0, 3 * world.wrong, 2))[None], fixed))
        if not fixed:
            measured, weight = point + rng.normal(0, 1, 2), 10.0 ** rng.uniform(-4, 0)
            factors.append(Factors("prior_point2", np.array([[key]]), measured[None], np.array([[1, 0, 1.0]]) * weight))
    away, loss = point - world.poses[i, :2], world.loss(0.5)
    if rng.random() < 0.5:
        kind, measured, sigma = "range_se2", abs(np.hypot(*away) * rng.choice([1, 1, 0.3]) + rng.normal(0, 0.1)), 0.1
    else:
        turned = np.arctan2(away[1], away[0]) - world.poses[i, 2]
        kind, measured, sigma = "bearing_se2", turned + rng.normal(0, 0.05) + rng.choice([0, 0, 0, np.pi]), 0.05
    factors.append(Factors(kind, np.array([[i, key]]), np.array([[measured]]), np.array([[sigma**-2]]), **loss))


def _link(world: _World, a: int, b: int, sigma: float, off: np.ndarray | float = 0.0, **loss: Any) -> Factors:
    start, end = world.poses[a], world.poses[b]
    c, s, d = np.cos(start[2]), np.sin(start[2]), end - start
    noise = world.rng.normal(0, 1, 3) * sigma
    measured = np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], d[2]]) + noise + off
    return Factors("between_se2", np.array([[a, b]]), measured[None], _weight(sigma**-2), **loss)


def _prior(i: int, measured: np.ndarray, weight: float, turn: float = 1.0) -> Factors:
    return Factors("prior_se2", np.array([[i]]), measured[None], _weight(weight, turn))


def _weight(weight: float, turn: float = 1.0) -> np.ndarray:
    return weight * np.array([[1, 0, 0, 1, 0, turn]])


def _composed(pose: np.ndarray, by: tuple[float, float, float]) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([pose[0] + c * by[0] - s * by[1], pose[1] + s * by[0] + c * by[1], pose[2] + by[2]])
