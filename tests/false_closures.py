"""Drives through simulated streets whose front end recognizes places that it is not at.

Right closures are those of `simulate.manhattan`.  False ones:

    random    the place of any earlier pose, at least five metres from where the robot is
    local     a place that it is at, with a position up to five metres off, at least half a metre, and a heading of up
              to 0.5 rad
    grouped   bursts of ten, pose by pose along the drive, consistent with each other, as of two corridors that look
              alike
"""

from dataclasses import dataclass

import numpy as np

from factorbus.proto.messages import Batch, Factors
from factorbus.simulate import manhattan

KINDS = ("random", "local", "grouped")
_BURST, _GAP = 10, 40
_SIGMA = 0.0225


@dataclass(frozen=True, slots=True)
class DriveWithFalse:
    """batches: one a pose, as a robot would insert it.  false: of each, how many of its last closures are.
    truth (n, 3): poses."""

    batches: list[Batch]
    false: list[int]
    truth: np.ndarray

    def is_false(self) -> np.ndarray:
        """Of all closures, in their order."""
        counts = [sum(int(is_closure(group).sum()) for group in batch.factors) for batch in self.batches]
        each = [[False] * (n - wrong) + [True] * wrong for n, wrong in zip(counts, self.false, strict=True)]
        return np.array([one for some in each for one in some], bool)


def is_closure(group: Factors) -> np.ndarray:
    """Which relative poses are not odometry."""
    return np.abs(group.keys[:, 0] - group.keys[:, 1]) != 1


def drive_with_false(poses: int, seed: int, share: float, kind: str) -> DriveWithFalse:
    """share: of all closures, the false ones."""
    rng = np.random.default_rng([seed, 7])
    steps = list(manhattan(poses, seed=seed))
    truth = np.concatenate([group.values for step in steps for group in step.truth if group.values is not None])
    right = sum(int(is_closure(group).sum()) for step in steps for group in step.batch.factors)
    made: list[list[tuple[int, np.ndarray]]] = [[] for _ in steps]
    wanted, count = round(right * share / (1.0 - share)), 0
    while count < wanted:
        found = _MAKE[kind](truth, rng)
        count += len(found)
        for pose, partner, z in found:
            made[pose].append((partner, z))
    batches = [_with(step.batch, int(steps[0].truth[0].keys[0]), pose, made[pose]) for pose, step in enumerate(steps)]
    return DriveWithFalse(batches, [len(some) for some in made], truth)


def _with(batch: Batch, first: int, pose: int, some: list[tuple[int, np.ndarray]]) -> Batch:
    if not some:
        return batch
    keys, z = np.array([[first + partner, first + pose] for partner, _ in some]), np.array([z for _, z in some])
    z[:, 2] = (z[:, 2] + np.pi) % (2.0 * np.pi) - np.pi
    information = np.tile(np.diag(np.full(3, _SIGMA**-2))[np.triu_indices(3)], (len(z), 1))
    return batch._replace(factors=(*batch.factors, Factors("between_se2", keys, z, information)))


_Found = list[tuple[int, int, np.ndarray]]  # the pose, the earlier one, and what was measured


def _random(truth: np.ndarray, rng: np.random.Generator) -> _Found:
    pose = int(rng.integers(_GAP + 5, len(truth)))
    partner = int(rng.integers(0, pose - _GAP))
    if np.linalg.norm(truth[partner, :2] - truth[pose, :2]) < 5.0:
        return []
    return [(pose, partner, _near(rng))]


def _local(truth: np.ndarray, rng: np.random.Generator) -> _Found:
    pose = int(rng.integers(_GAP + 5, len(truth)))
    here = np.flatnonzero(np.linalg.norm(truth[: pose - _GAP, :2] - truth[pose, :2], axis=1) <= 3.0)
    off = rng.uniform(-5.0, 5.0, 2)
    if not here.size or not 0.5 < np.linalg.norm(off) < 5.0:
        return []
    partner = int(rng.choice(here))
    T = np.linalg.inv(_matrix(truth[partner])) @ _matrix(truth[pose]) @ _matrix([*off, rng.uniform(-0.5, 0.5)])
    return [(pose, partner, _noisy(T, rng))]


def _grouped(truth: np.ndarray, rng: np.random.Generator) -> _Found:
    pose = int(rng.integers(60, len(truth) - _BURST))
    partner, back = int(rng.integers(0, pose - 50)), rng.random() < 0.5
    moved = _matrix(truth[partner]) @ _matrix(_near(rng)) @ np.linalg.inv(_matrix(truth[pose]))
    found: _Found = []
    for k in range(_BURST):
        other = partner + (_BURST - 1 - k if back else k)
        T = np.linalg.inv(_matrix(truth[other])) @ moved @ _matrix(truth[pose + k])
        found.append((pose + k, other, _noisy(T, rng)))
    return found


_MAKE = {"random": _random, "local": _local, "grouped": _grouped}


def _near(rng: np.random.Generator) -> np.ndarray:
    """A place that a front end may say it sees from a pose: along the streets, two metres off at most."""
    return np.array([*rng.uniform(-2.0, 2.0, 2), rng.integers(4) * np.pi / 2.0 - np.pi])


def _matrix(pose: np.ndarray | list[float]) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def _noisy(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.array([T[0, 2], T[1, 2], np.arctan2(T[1, 0], T[0, 0])]) + rng.normal(0.0, _SIGMA, 3)
