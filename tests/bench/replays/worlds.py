"""Worlds of `bench peers`: kinds of data that differ in what is seen how often, drawn from a seed.

manhattan      streets of a grid, loops at places seen before
noisy_streets  the same with odometry and loops of 0.1 m and 0.03 rad
city_trees     streets, and many trees, each seen from a few poses
few_landmarks  a court with fifteen landmarks, half of which every pose sees
office         short corridors, and up to four matches a pose, most of them to the last twenty
sphere         a spiral over a sphere and back, in space
torus          a spiral around a torus, lap after lap, in space
robots         three robots at once in the same streets, with loops between them
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import LoopClosures, Spiral, Step, city_trees, manhattan, sphere
from factorbus.simulate.noise import (
    diagonal_information,
    noisy_se2,
    noisy_se3,
    quaternion_product,
    relative_se2,
    relative_se3,
    seen_from,
)
from factorbus.simulate.step import POINT, POSE

from .columns import F64, I64

ROBOTS, LANDMARKS, SEEN = 3, 15, 0.5
_MET = np.array([0.5, 0.5, 0.1])  # σ with which the first poses of robots know each other: m, m, rad
_ODOMETRY, _SIGHT = np.array([0.02, 0.02, 0.01]), np.array([0.1, 0.1])
_COURT_M, _WAY_M = 40.0, 0.3
_RING, _RINGS, _MAJOR_M, _MINOR_M = 20, 50, 30.0, 8.0
_IN_SPACE = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])
_AGAIN = 0.2  # of poses on a torus from the second lap on, those that know the pose of the lap before


def few_landmarks(poses: int, seed: int) -> Iterator[Batch]:
    """Closed curves through a court."""
    rng = np.random.default_rng([seed, 5])
    points = rng.uniform(-_COURT_M / 2, _COURT_M / 2, (LANDMARKS, 2))
    truth = _curve(poses, rng.uniform(0.0, 2.0 * math.pi))
    way = _measured_se2(truth[:-1], truth[1:], _ODOMETRY, rng)
    known: set[int] = set()
    for n in range(poses):
        seen = np.flatnonzero(rng.random(LANDMARKS) < SEEN)
        z = (
            seen_from(np.repeat(truth[n : n + 1], len(seen), axis=0), points[seen])
            + rng.normal(size=(len(seen), 2)) * _SIGHT
        )
        new = [k for k in seen.tolist() if k not in known]
        known.update(new)
        variables, factors = [_pose("se2", n, truth)], list[Factors]()
        if new:
            variables.append(Variables("point2", POINT + np.array(new)))
        if n:
            factors.append(_between("between_se2", np.array([[n - 1, n]]), way[n - 1 : n], _ODOMETRY))
        if len(seen):
            ends = np.stack([np.full(len(seen), POSE + n), POINT + seen], axis=1)
            factors.append(Factors("landmark_se2", ends, z, diagonal_information(_SIGHT, len(seen))))
        yield Batch(tuple(variables), tuple(factors))


def torus(poses: int, seed: int, sigmas: F64 = _IN_SPACE) -> Iterator[Batch]:
    """Each pose knows the one before and the one a turn earlier; some the one of the lap before.

    sigmas (6,): of relative poses, metres and the vector part of a quaternion.
    """
    rng, lap = np.random.default_rng([seed, 6]), _RING * _RINGS
    truth = on_torus(np.arange(poses))
    for n in range(poses):
        others = [n - 1] * (n > 0) + [n - _RING] * (n >= _RING) + [n - lap] * (n >= lap and rng.random() < _AGAIN)
        factors = ()
        if others:
            T = relative_se3(truth[others], np.repeat(truth[n : n + 1], len(others), axis=0))
            z = noisy_se3(T, rng.normal(size=(len(others), 6)) * sigmas)
            pairs = np.array([[other, n] for other in others])
            factors = (_between("between_se3", pairs, z, sigmas),)
        yield Batch((_pose("se3", n, truth),), factors)


def robots(poses: int, seed: int) -> Iterator[Batch]:
    """One drive through streets in three parts, driven at once: a loop comes when both of its poses are there."""
    rng, drive = np.random.default_rng([seed, 7]), [*islice(manhattan(poses, seed), poses)]
    share = -(-poses // ROBOTS)
    came = sorted(range(poses), key=lambda n: (n % share, n))
    at = {POSE + n: k for k, n in enumerate(came)}
    truth = np.concatenate([np.zeros((0, 3)) if (x := step.truth[0].values) is None else x for step in drive])
    loops: list[list[Factors]] = [[] for _ in came]
    for first in range(share, poses, share):
        z = _measured_se2(truth[:1], truth[first : first + 1], _MET, rng)
        loops[at[POSE + first]].append(_between("between_se2", np.array([[0, first]]), z, _MET))
    for n, step in enumerate(drive):
        for group in step.batch.factors:
            for row, ends in enumerate(group.keys.tolist()):
                if ends == [POSE + n - 1, POSE + n] and n % share == 0:
                    continue  # from the end of one robot's part to the beginning of the next
                one = slice(row, row + 1)
                part = Factors(group.kind, group.keys[one], group.measured[one], group.information[one])
                loops[max(at[end] for end in ends)].append(part)
    for n, factors in zip(came, loops, strict=True):
        yield Batch((_pose("se2", n, truth),), tuple(_together(factors)))


def batches(steps: Iterator[Step]) -> Iterator[Batch]:
    """What a robot would insert at each step."""
    return (step.batch for step in steps)


_DENSE = LoopClosures(share=1.0, most=4, radius_m=3.0, gap=3)
WORLDS: Mapping[str, Callable[[int, int], Iterator[Batch]]] = {
    "manhattan": lambda poses, seed: batches(manhattan(poses, seed)),
    "noisy_streets": lambda poses, seed: batches(manhattan(poses, seed, sigma_xy_m=0.1, sigma_theta_rad=0.03)),
    "city_trees": lambda poses, seed: batches(city_trees(poses, seed)),
    "few_landmarks": few_landmarks,
    "office": lambda poses, seed: batches(manhattan(poses, seed, block_m=3, loops=_DENSE)),
    "sphere": lambda poses, seed: batches(sphere(poses, seed, spiral=Spiral(ring=40, rings=25))),
    "torus": torus,
    "robots": robots,
}


def _pose(kind: str, n: int, truth: F64) -> Variables:
    return Variables(kind, np.array([POSE + n]), truth[:1] if n == 0 else None, n == 0)


def _between(kind: str, pairs: I64, z: F64, sigmas: F64) -> Factors:
    return Factors(kind, POSE + pairs, z, diagonal_information(sigmas, len(z)))


def _measured_se2(start: F64, end: F64, sigmas: F64, rng: np.random.Generator) -> F64:
    T = relative_se2(start, end)
    return noisy_se2(T, rng.normal(size=T.shape) * sigmas)


def _together(factors: Sequence[Factors]) -> Iterator[Factors]:
    """Factors of one kind as one group."""
    if factors:
        keys, measured, information = (
            np.concatenate([getattr(each, name) for each in factors]) for name in ("keys", "measured", "information")
        )
        yield Factors(factors[0].kind, keys, measured, information)


def _curve(poses: int, phase: float) -> F64:
    """(n, 3): a curve of Lissajous, some _WAY_M from pose to pose, headings along it."""
    reach = 0.4 * _COURT_M
    s = phase + np.arange(poses + 1) * _WAY_M / (2.0 * reach)
    xy = reach * np.stack([np.sin(2.0 * s), np.sin(3.0 * s + 0.5)], axis=1)
    dx, dy = np.diff(xy, axis=0).T
    return np.concatenate([xy[:-1], np.arctan2(dy, dx)[:, None]], axis=1)


def on_torus(numbers: I64) -> F64:
    """(n, 7): x along the turn, z away from the tube."""
    around, along = 2.0 * np.pi * numbers / _RING, 2.0 * np.pi * numbers / (_RING * _RINGS)
    far = _MAJOR_M + _MINOR_M * np.cos(around)
    at = np.stack([far * np.cos(along), far * np.sin(along), _MINOR_M * np.sin(around)], axis=1)
    zero = np.zeros_like(around)
    turned = np.stack([zero, zero, np.sin(along / 2), np.cos(along / 2)], axis=1)
    tilted = np.stack([zero, -np.sin(around / 2), zero, np.cos(around / 2)], axis=1)
    quat = quaternion_product(turned, tilted)
    return np.concatenate([at, np.where(quat[:, 3:] < 0, -quat, quat)], axis=1)
