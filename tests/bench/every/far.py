"""Landmarks far away, seen from a drive whose heading is hardly known.

To turn a stretch of the drive and to shift what is seen from it changes little, if both go together along a curve: χ²
has curved valleys, along which Gauss-Newton steps gain hardly less than the ones before.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from bench.replays.columns import F64

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

from .hard import X
from .motion import Chance, Motion, between, factor

LANDMARK = symbol("l", 0)
_HELD = 0.01  # σ of the prior of the first pose, in metres and radians
_FIRST_M = 1.0  # σ of the first sight of a landmark
_CLOSURE = (0.05, 0.01)  # σ in metres and radians
_TURNS = {"se2": (0.03, 0.08, 0.2), "se3": (0.015, 0.04)}  # σ of a step of odometry, radians
_LAST = 4  # landmarks of which one may be seen again


@dataclass(frozen=True, slots=True)
class _World:
    """What is drawn once.

    motion: with the σ of odometry; every: poses to a loop closure, and to half a circle; far_m: of landmarks; sight,
    sigmas: what sees them again, and how well; seen: how often; weight: of all information
    """

    motion: Motion
    size: int
    every: int
    far_m: float
    sight: str
    sigmas: tuple[float, ...]
    seen: float
    weight: float
    held: bool


def far_landmarks(motion: Motion, poses: int, seed: int) -> Iterator[Batch]:
    """A drive in circles that closes loops now and then, past landmarks 25 to 600 m away.

    Drawn: how far they are, how often there is a new one and one is seen again, by which kind and how well; σ of
    odometry, 0.015 to 0.2 rad a step; whether all weighs a hundredth of what it should, and χ² is next to nothing.
    """
    chance = np.random.default_rng([seed, 17])
    world = _draw(chance, motion)
    truth, landmarks = _circles(motion, poses, world.every), list[F64]()
    for i in range(poses):
        batch = world.motion.pose(chance, X, i, truth, prior=None if world.held else (_HELD,) * len(motion.sigmas))
        variables, factors = list(batch.variables), list(batch.factors)
        if i and i % world.every == 0:
            factors.append(_closure(chance, motion, truth, i, world))
        if i % (world.every // 3 + 1) == 0:
            key = LANDMARK + len(landmarks)
            direction = chance.normal(size=world.size)
            away = world.far_m * chance.uniform(0.5, 1.2) * direction / np.linalg.norm(direction)
            landmarks.append(truth[i, : world.size] + away)
            variables.append(Variables(f"point{world.size}", np.array([key])))
            place, sigmas = _local(motion, truth[i], landmarks[-1]), (_FIRST_M,) * world.size
            factors.append(_sight(chance, f"landmark_{motion.kind}", (X + i, key), place, sigmas))
        if i < 3 or chance.random() < world.seen:
            k = max(len(landmarks) - 1 - int(chance.integers(_LAST)), 0)
            place = _local(motion, truth[i], landmarks[k])
            factors.append(_sight(chance, f"{world.sight}_{motion.kind}", (X + i, LANDMARK + k), place, world.sigmas))
        weighed = [group._replace(information=world.weight * group.information) for group in factors]
        yield Batch(tuple(variables), tuple(weighed))


def _draw(chance: Chance, motion: Motion) -> _World:
    plane = motion.kind == "se2"
    size, turns = (2, 1) if plane else (3, 3)
    turn, shift = float(chance.choice(_TURNS[motion.kind])), float(chance.choice([0.02, 0.1]))
    metres, radians = float(chance.choice([0.05, 0.5])), float(chance.choice([0.005, 0.02]))
    sight = str(chance.choice(["landmark", "range", "bearing", "bearing_range"] if plane else ["landmark", "range"]))
    sigmas = {
        "landmark": (metres,) * size,
        "range": (metres,),
        "bearing": (radians,),
        "bearing_range": (radians, metres),
    }
    return _World(
        replace(motion, sigmas=(shift,) * size + (turn,) * turns),
        size,
        int(chance.choice([15, 30, 60])),
        float(chance.choice([50.0, 150.0, 500.0])),
        sight,
        sigmas[sight],
        float(chance.choice([1.0, 0.3, 0.05])),
        float(chance.choice([1.0, 1.0, 0.01])),
        bool(chance.random() < 0.5),
    )


def _circles(motion: Motion, poses: int, every: int) -> F64:
    """A metre a step, round a circle one way and then the other, not quite even."""
    rows = [motion.small(np.zeros(len(motion.sigmas)))]
    for n in range(1, poses):
        turn = np.pi / every * (1.0 if n // (4 * every) % 2 == 0 else -1.0)
        step = np.zeros(len(motion.sigmas))
        step[0], step[-1] = 1.0, turn + (0.1 * np.sin(n) if motion.kind == "se2" else 0.0)
        if motion.kind == "se3":
            step[3:] = 0.5 * step[3:]  # what of a quaternion is not its real part
            step[2:5] = 0.02 * np.sin(n / 5), 0.01 * np.cos(n / 7), 0.01 * np.sin(n / 3)
        rows.append(motion.compose(rows[-1], motion.small(step)))
    return np.array(rows)


def _closure(chance: Chance, motion: Motion, truth: F64, i: int, world: _World) -> Factors:
    """To the nearest pose of before, or to any."""
    before = max(i - world.every // 2, 1)
    away = np.linalg.norm(truth[:before, : world.size] - truth[i, : world.size], axis=1)
    j = int(np.argmin(away)) if chance.random() < 0.7 else int(chance.integers(before))
    sigmas = (_CLOSURE[0],) * world.size + (_CLOSURE[1],) * (len(motion.sigmas) - world.size)
    z = replace(motion, sigmas=sigmas).measured(chance, truth[j], truth[i])
    return between(motion.between, X + j, X + i, z, sigmas)


def _local(motion: Motion, pose: F64, place: F64) -> F64:
    """A place in the frame of a pose."""
    there = motion.small(np.zeros(len(motion.sigmas)))
    there[: len(place)] = place
    return motion.compose(motion.inverse(pose), there)[: len(place)]


def _sight(chance: Chance, kind: str, ends: tuple[int, int], place: F64, sigmas: tuple[float, ...]) -> Factors:
    """Of a landmark that is at `place` in the frame of the pose."""
    angle, distance = np.arctan2(place[1], place[0]), np.linalg.norm(place)
    exact = {"landmark": place, "range": [distance], "bearing": [angle], "bearing_range": [angle, distance]}
    z = np.array(exact[kind.rpartition("_")[0]], float) + chance.normal(size=len(sigmas)) * sigmas
    if "range" in kind:
        z[-1] = abs(z[-1])
    return factor(kind, list(ends), z, sigmas)
