"""Drives of a robot with an IMU whose biases wander, and a receiver that says where it is now and then."""

from collections.abc import Iterator

import numpy as np
from naive.dense_factors import boxplus
from naive.dense_imu import follow
from naive.random_graphs import factor, random_information, random_value
from naive.random_others import random_other

from factorbus.proto.kinds import imu_kind
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

NOISE = np.array([0.05, 0.2, 0.02, 0.05, 0.05])
GRAVITY = np.array([0.5, -0.25, -9.7])
KINDS = ("se3", "vector3", "vector6")


def random_imu(samples: int, rng: np.random.Generator, quick: float = 1.0) -> np.ndarray:
    """A measurement of a body that turns and shakes; quick: by how much, against rad/s and some m/s²."""
    durations = rng.uniform(0.02, 0.08, (samples, 1))
    rates = np.hstack([rng.normal(0, quick, (samples, 3)), rng.normal(0, 3 * quick, (samples, 3)) - GRAVITY])
    bias = rng.normal(0, 0.05, 6)
    return np.concatenate([NOISE, GRAVITY, bias, np.hstack([durations, rates]).ravel()])


def random_ends(z: np.ndarray, rng: np.random.Generator, off: float = 0.3) -> list[np.ndarray]:
    """Values of the six variables, those of b off what follows from those of a."""
    a = [random_value(kind, rng) for kind in KINDS]
    a[2] *= 0.05
    b = [*follow(z, *a), a[2]]
    dims = [3 if kind == "vector3" else 6 for kind in KINDS]
    return a + [boxplus(kind, x, rng.normal(0, off, d)) for kind, x, d in zip(KINDS, b, dims, strict=True)]


def keys_of(n: int) -> list[int]:
    """Pose, velocity and bias of a moment."""
    return [symbol(letter, n) for letter in "xvb"]


def imu_steps(seed: int, steps: int = 8, loss: str = "") -> Iterator[Batch]:
    """Poses, velocities and biases but the first come without values."""
    rng, truth = np.random.default_rng(seed), dict[int, np.ndarray]()

    def prior(kind: str, key: int, sigma: float) -> Factors:
        d = 3 if kind == "vector3" else 6
        y = truth[key] + rng.normal(0, sigma, d)
        z = np.concatenate([y, np.eye(d).ravel(), np.zeros(d)])
        return Factors(
            f"linear_{d}_{kind}", np.array([[key]]), z[None], (np.eye(d) / sigma**2)[np.triu_indices(d)][None]
        )

    def softened(group: Factors) -> Factors:
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    for n in range(steps):
        keys, factors = keys_of(n), list[Factors]()
        if n == 0:
            values = [np.array([0, 0, 0, 0, 0, 0, 1.0]), np.array([1.0, 0.2, 0]), rng.normal(0, 0.05, 6)]
            truth |= dict(zip(keys, values, strict=True))
            factors += [factor("prior_se3", keys[:1], truth, 0.01, rng)]
            factors += [prior("vector3", keys[1], 0.1), prior("vector6", keys[2], 0.05)]
        else:
            before = keys_of(n - 1)
            z = random_imu(int(rng.integers(3, 6)), rng, 0.7)
            pose, velocity = follow(z, *(truth[key] for key in before))
            bias = truth[before[2]] + rng.normal(0, 0.002, 6)
            truth |= dict(zip(keys, (pose, velocity, bias), strict=True))
            rates = z[14:].reshape(-1, 7)[:, 1:]
            rates += rng.normal(0, 0.05, rates.shape)
            kind = imu_kind((len(z) - 14) // 7)
            information = random_information(15, rng) if n % 3 == 0 else np.eye(15)[np.triu_indices(15)]
            factors += [softened(Factors(kind.name, np.array([[*before, *keys]]), z[None], information[None]))]
        if n % 2 == 0:
            there = random_other("position_se3", [truth[keys[0]]], 0.05, rng)
            factors.append(
                softened(Factors("position_se3", np.array([keys[:1]]), there[None], random_information(3, rng)[None]))
            )
        if n > 2 and n % 3 == 0:
            factors.append(factor("between_se3", [keys_of(n - 2)[0], keys[0]], truth, 0.03, rng))
        given = [truth[key] if n == 0 else None for key in keys]
        variables = tuple(
            Variables(kind, np.array([key]), None if value is None else value[None])
            for kind, key, value in zip(KINDS, keys, given, strict=True)
        )
        yield Batch(variables, tuple(factors))
