"""Drives through the same simulated town, day after day: `sessions` has what each measures.

The way is that of `simulate`, through streets of a grid; each day it is driven again, up to half a metre to the side
and half a metre along, and with measurements drawn anew.
"""

from dataclasses import dataclass
from itertools import islice
from random import Random

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate.manhattan import true_poses
from factorbus.simulate.noise import diagonal_information, noisy_se2, relative_se2
from factorbus.simulate.walk import walk_streets

SIGMAS = np.array([0.0225, 0.0225, 0.0225])
RADIUS_M, SHARE, MOST, GAP = 2.0, 0.5, 2, 40  # of closures, as `LoopClosures` has them
_SIDE_M, _HEADING_RAD = 0.3, 0.05


@dataclass(frozen=True, slots=True)
class Town:
    """truth (poses, 3) of the way as it was drawn."""

    way: F64
    seed: int

    def day(self, number: int) -> F64:
        """Where the robot is on that day (poses, 3)."""
        rng = np.random.default_rng([self.seed, number])
        theta = self.way[:, 2]
        along, side = rng.uniform(-0.5, 0.5), np.clip(rng.normal(0.0, _SIDE_M, len(theta)), -0.5, 0.5)
        c, s = np.cos(theta), np.sin(theta)
        turned = theta + rng.normal(0.0, _HEADING_RAD, len(theta))
        return np.stack([self.way[:, 0] + along * c - side * s, self.way[:, 1] + along * s + side * c, turned], axis=1)


def town(poses: int, seed: int) -> Town:
    """A way of as many metres as `poses`."""
    return Town(true_poses(list(islice(walk_streets(Random(f"streets {seed}"), 5, straight=0.5), poses))), seed)


def key_of(day: int, pose: int) -> int:
    """Each day has a letter of its own."""
    return (ord("a") + day - 1) << 56 | pose


class Places:
    """The poses that a front end may recognize, and where they are in truth."""

    def __init__(self) -> None:
        self._at: dict[tuple[int, int], dict[int, F64]] = {}

    def add(self, key: int, pose: F64) -> None:
        self._at.setdefault(_square(pose), {})[key] = pose

    def forget(self, key: int, pose: F64) -> None:
        """It is not in the map any more."""
        del self._at[_square(pose)][key]

    def near(self, pose: F64) -> list[tuple[int, F64]]:
        """Within RADIUS_M, by key."""
        x, y = _square(pose)
        found = [
            (key, there) for dx in (-1, 0, 1) for dy in (-1, 0, 1)
            for key, there in self._at.get((x + dx, y + dy), {}).items()
            if np.hypot(*(there - pose)[:2]) <= RADIUS_M
        ]  # fmt: skip
        return sorted(found, key=lambda each: each[0])


def _square(pose: F64) -> tuple[int, int]:
    x, y = np.floor(pose[:2] / RADIUS_M).astype(int).tolist()
    return x, y


class FrontEnd:
    """What the robot sends, pose by pose: odometry, and closures to poses that the map has."""

    def __init__(self, seed: int) -> None:
        self._rng, self._places = np.random.default_rng([seed, 99]), Places()
        self._waiting: list[tuple[int, F64]] = []
        self.truth: dict[int, F64] = {}

    def step(self, day: int, k: int, poses: F64) -> Batch:
        """Pose k of a day; the first of all is fixed."""
        key, here = key_of(day, k), poses[k]
        first = not self.truth
        pairs: list[tuple[int, F64]] = [(key_of(day, k - 1), poses[k - 1])] if k else []
        if k == 0 or self._rng.random() < SHARE:
            near = self._places.near(here)
            picked = self._rng.permutation(len(near))[:MOST]
            pairs += [near[n] for n in sorted(picked.tolist())]
        self.truth[key] = here
        self._waiting.append((key, here))
        if len(self._waiting) > GAP:
            self._places.add(*self._waiting.pop(0))
        variables = Variables("se2", np.array([key]), here[None] if first else None, fixed=first)
        if not pairs:
            return Batch((variables,), ())
        T = relative_se2(np.stack([pose for _, pose in pairs]), np.tile(here, (len(pairs), 1)))
        z = noisy_se2(T, self._rng.normal(size=T.shape) * SIGMAS)
        keys = np.array([[partner, key] for partner, _ in pairs], np.int64)
        return Batch((variables,), (Factors("between_se2", keys, z, diagonal_information(SIGMAS, len(z))),))

    def end_day(self) -> None:
        """What was driven today is recognized tomorrow."""
        for each in self._waiting:
            self._places.add(*each)
        self._waiting = []

    def gone(self, keys: I64) -> None:
        """These are not in the map any more."""
        for key in keys.tolist():
            waiting = [each for each in self._waiting if each[0] != key]
            if len(waiting) < len(self._waiting):
                self._waiting = waiting
            else:
                self._places.forget(key, self.truth[key])
