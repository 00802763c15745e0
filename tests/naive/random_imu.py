"""Drives of a robot with an IMU whose biases wander, and a receiver that says where it is now and then."""

from collections.abc import Iterator

import numpy as np
from naive.dense_factors import boxplus
from naive.dense_imu import IDENTITY, follow
from naive.random_graphs import factor, random_information, random_value
from naive.random_others import random_other

from factorbus.client import ImuNoise
from factorbus.client.preintegration import preintegrate_samples
from factorbus.proto import inertial as of
from factorbus.proto.inertial import ImuForm
from factorbus.proto.kinds import inertial_kind
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

NOISE = np.array([0.05, 0.2, 0.02, 0.05, 0.05])
GRAVITY = np.array([0.5, -0.25, -9.7])
KINDS = ("se3", "vector3", "vector6")


def random_samples(count: int, rng: np.random.Generator, quick: float = 1.0) -> np.ndarray:
    """(n, 7) of a body that turns and shakes; quick: by how much, against rad/s and some m/s²."""
    durations = rng.uniform(0.02, 0.08, (count, 1))
    rates = np.hstack([rng.normal(0, quick, (count, 3)), rng.normal(0, 3 * quick, (count, 3)) - GRAVITY])
    return np.hstack([durations, rates])


def random_imu(form: ImuForm, rng: np.random.Generator, quick: float = 1.0, mounted: bool = True) -> np.ndarray:
    """A measurement of such a body.  mounted: the IMU is beside its middle, and turned."""
    rows, bias = random_samples(form.samples or 5, rng, quick), rng.normal(0, 0.05, of.BIAS)
    mount = random_mount(rng) if mounted else IDENTITY
    known = np.concatenate([bias, *[GRAVITY] * (not form.gravity), *[mount] * (not form.mount)])
    if form.samples:
        return np.concatenate([NOISE, known, rows.ravel()])
    return np.concatenate([known, preintegrate_samples(rows, ImuNoise(*NOISE), bias).numbers])


def random_mount(rng: np.random.Generator) -> np.ndarray:
    return boxplus("se3", IDENTITY, rng.normal(0, 0.3, 6))


def random_ends(form: ImuForm, z: np.ndarray, rng: np.random.Generator, off: float = 0.3) -> list[np.ndarray]:
    """Values of the variables, those of b off what follows from those of a."""
    a = [random_value(kind, rng) for kind in KINDS]
    a[2] *= 0.05
    further = [*[random_mount(rng)] * form.mount, *[GRAVITY + rng.normal(0, 0.5, 3)] * form.gravity]
    b = [*follow(form, z, [*a, *a, *further]), a[2]]
    dims = [3 if kind == "vector3" else 6 for kind in KINDS]
    return a + [boxplus(kind, x, rng.normal(0, off, d)) for kind, x, d in zip(KINDS, b, dims, strict=True)] + further


def keys_of(n: int) -> list[int]:
    """Pose, velocity and bias of a moment."""
    return [symbol(letter, n) for letter in "xvb"]


MOUNT_KEY, GRAVITY_KEY = symbol("m", 0), symbol("g", 0)


def imu_steps(seed: int, steps: int = 8, loss: str = "", of_form: ImuForm | None = None) -> Iterator[Batch]:
    """Poses, velocities and biases but the first come without values.

    of_form: of the factors; with a variable mount or gravity these are known a little.  Without, samples of an IMU that
    is where the poses are.
    """
    rng, truth, form = np.random.default_rng(seed), dict[int, np.ndarray](), of_form or ImuForm(1)
    mount = IDENTITY if of_form is None else random_mount(rng)
    further = [*[MOUNT_KEY] * form.mount, *[GRAVITY_KEY] * form.gravity]
    truth |= {MOUNT_KEY: mount, GRAVITY_KEY: GRAVITY}

    def prior(kind: str, key: int, sigma: float) -> Factors:
        d = 3 if kind == "vector3" else 6
        y = boxplus(kind, truth[key], rng.normal(0, sigma, d))
        z = np.concatenate([y, np.eye(d).ravel(), np.zeros(d)])
        return Factors(
            f"linear_{d}_{kind}", np.array([[key]]), z[None], (np.eye(d) / sigma**2)[np.triu_indices(d)][None]
        )

    def softened(group: Factors) -> Factors:
        return group._replace(loss=loss, scale=np.array([1.5])) if loss else group

    def measured(before: list[int], keys: list[int]) -> Factors:
        """Samples of the truth, from where that goes on, with noise; or what they are integrated to."""
        true = ImuForm(int(rng.integers(3, 6)))
        rows, bias = random_samples(true.samples, rng, 0.7), rng.normal(0, 0.05, of.BIAS)
        z = np.concatenate([NOISE, bias, GRAVITY, mount, rows.ravel()])
        pose, velocity = follow(true, z, [truth[key] for key in (*before, *before)])
        after = pose, velocity, truth[before[2]] + rng.normal(0, 0.002, 6)
        truth.update(dict(zip(keys, after, strict=True)))
        rows[:, 1:] += rng.normal(0, 0.05, (true.samples, 6))
        known = np.concatenate([bias, *[GRAVITY] * (not form.gravity), *[mount] * (not form.mount)])
        information = random_information(15, rng) if n % 3 == 0 else np.eye(15)[np.triu_indices(15)]
        if form.samples:
            kind = inertial_kind(ImuForm(true.samples, form.mount, form.gravity))
            z = np.concatenate([NOISE, known, rows.ravel()])
        else:
            kind, made = inertial_kind(form), preintegrate_samples(rows, ImuNoise(*NOISE), bias)
            z, information = np.concatenate([known, made.numbers]), made.information[np.triu_indices(15)]
        return Factors(kind.name, np.array([[*before, *keys, *further]]), z[None], information[None])

    for n in range(steps):
        keys, factors = keys_of(n), list[Factors]()
        if n == 0:
            values = [IDENTITY, np.array([1.0, 0.2, 0]), rng.normal(0, 0.05, 6)]
            truth |= dict(zip(keys, values, strict=True))
            factors += [factor("prior_se3", keys[:1], truth, 0.01, rng)]
            factors += [prior("vector3", keys[1], 0.1), prior("vector6", keys[2], 0.05)]
            factors += [prior("se3" if key == MOUNT_KEY else "vector3", key, 0.03) for key in further]
            if form.gravity:
                length = np.array([[np.linalg.norm(GRAVITY) + 0.005]])
                factors += [Factors("length_vector3", np.array([[GRAVITY_KEY]]), length, np.array([[1e4]]))]
        else:
            factors += [softened(measured(keys_of(n - 1), keys))]
        if n % 2 == 0:
            there = random_other("position_se3", [truth[keys[0]]], 0.05, rng)
            factors.append(
                softened(Factors("position_se3", np.array([keys[:1]]), there[None], random_information(3, rng)[None]))
            )
        if n > 2 and n % 3 == 0:
            factors.append(factor("between_se3", [keys_of(n - 2)[0], keys[0]], truth, 0.03, rng))
        given = [truth[key] if n == 0 else None for key in keys]
        variables = [
            Variables(kind, np.array([key]), None if value is None else value[None])
            for kind, key, value in zip(KINDS, keys, given, strict=True)
        ]
        if n == 0:
            kinds = ["se3" if key == MOUNT_KEY else "vector3" for key in further]
            variables += [
                Variables(kind, np.array([key]), truth[key][None]) for kind, key in zip(kinds, further, strict=True)
            ]
        yield Batch(tuple(variables), tuple(factors))
