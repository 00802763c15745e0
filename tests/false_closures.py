"""Drives whose front end recognizes places that it is not at: through simulated streets, or of a public data set.

Right closures are those of `simulate.manhattan`, or of the file.  False ones:

    random    the place of any earlier pose, at least five metres from where the robot is
    local     a place that it is at, with a position up to five metres off, at least half a metre, and a heading of up
              to 0.5 rad; in space about every axis
    grouped   bursts of ten, pose by pose along the drive, consistent with each other, as of two corridors that look
              alike
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from naive.dense_poses import pose_matrix, pose_vector
from scipy.spatial.transform import Rotation

from factorbus.proto.messages import Batch, Factors
from factorbus.proto.roles import pick_factors
from factorbus.simulate import manhattan

KINDS = ("random", "local", "grouped")
_BURST, _GAP = 10, 40
_SIGMA = 0.0225


@dataclass(frozen=True, slots=True)
class DriveWithFalse:
    """batches: one a pose, as a robot would insert it.  false: of each, how many of its last closures are.
    truth (n, 3 or 7): poses."""

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
    """Through streets drawn anew; share: of all closures, the false ones."""
    steps = list(manhattan(poses, seed=seed))
    truth = np.concatenate([group.values for step in steps for group in step.truth if group.values is not None])
    return with_false([step.batch for step in steps], truth, seed, share, kind)


def with_false(batches: Sequence[Batch], truth: np.ndarray, seed: int, share: float, kind: str) -> DriveWithFalse:
    """The same batches, of one pose each, with false closures; these have the information of the first right one."""
    rng = np.random.default_rng([seed, 7])
    own = [pick_factors(g, is_closure(g)) for b in batches for g in b.factors if is_closure(g).any()]
    right = sum(len(group.keys) for group in own)
    made: list[list[tuple[int, np.ndarray]]] = [[] for _ in batches]
    wanted, count = round(right * share / (1.0 - share)), 0
    while count < wanted:
        found = _MAKE[kind](truth, rng)
        count += len(found)
        for pose, partner, z in found:
            made[pose].append((partner, z))
    first = int(batches[0].variables[0].keys[0])
    every = [_with(batch, own[0], first, pose, made[pose]) for pose, batch in enumerate(batches)]
    return DriveWithFalse(every, [len(some) for some in made], truth)


def _with(batch: Batch, like: Factors, first: int, pose: int, some: list[tuple[int, np.ndarray]]) -> Batch:
    if not some:
        return batch
    keys, z = np.array([[first + partner, first + pose] for partner, _ in some]), np.array([z for _, z in some])
    information = np.tile(like.information[:1], (len(z), 1))
    return batch._replace(factors=(*batch.factors, Factors(like.kind, keys, z, information)))


_Found = list[tuple[int, int, np.ndarray]]  # the pose, the earlier one, and what was measured


def _random(truth: np.ndarray, rng: np.random.Generator) -> _Found:
    pose = int(rng.integers(_GAP + 5, len(truth)))
    partner, size = int(rng.integers(0, pose - _GAP)), _places(truth)
    if np.linalg.norm(truth[partner, :size] - truth[pose, :size]) < 5.0:
        return []
    return [(pose, partner, pose_vector(_near(size, rng)))]


def _local(truth: np.ndarray, rng: np.random.Generator) -> _Found:
    size = _places(truth)
    pose = int(rng.integers(_GAP + 5, len(truth)))
    distance = np.linalg.norm(truth[: pose - _GAP, :size] - truth[pose, :size], axis=1)
    here = np.flatnonzero(distance <= (3.0 if size == 2 else max(3.0, distance.min())))
    off = rng.uniform(-5.0, 5.0, size)
    if not here.size or not 0.5 < np.linalg.norm(off) < 5.0:
        return []
    partner = int(rng.choice(here))
    T = _between(truth[partner], truth[pose]) @ _turned(off, rng.uniform(-0.5, 0.5, 2 * size - 3))
    return [(pose, partner, _noisy(T, rng))]


def _grouped(truth: np.ndarray, rng: np.random.Generator) -> _Found:
    pose = int(rng.integers(60, len(truth) - _BURST))
    partner, back = int(rng.integers(0, pose - 50)), rng.random() < 0.5
    moved = pose_matrix(truth[partner]) @ _near(_places(truth), rng) @ np.linalg.inv(pose_matrix(truth[pose]))
    found: _Found = []
    for k in range(_BURST):
        other = partner + (_BURST - 1 - k if back else k)
        T = np.linalg.inv(pose_matrix(truth[other])) @ moved @ pose_matrix(truth[pose + k])
        found.append((pose + k, other, _noisy(T, rng)))
    return found


_MAKE = {"random": _random, "local": _local, "grouped": _grouped}


def _places(truth: np.ndarray) -> int:
    return 2 if truth.shape[1] == 3 else 3


def _near(size: int, rng: np.random.Generator) -> np.ndarray:
    """A place that a front end may say it sees from a pose: along the streets, two metres off at most."""
    place = rng.uniform(-2.0, 2.0, size)
    heading = rng.integers(4) * np.pi / 2.0 - np.pi
    return _turned(place, np.array([heading] if size == 2 else [0.0, 0.0, heading]))


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.inv(pose_matrix(a)) @ pose_matrix(b)


def _turned(place: np.ndarray, turn: np.ndarray) -> np.ndarray:
    if place.size == 2:
        return pose_matrix(np.append(place, turn))
    return pose_matrix(np.append(place, Rotation.from_rotvec(turn).as_quat()))


def _noisy(T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    size = len(T) - 1
    return pose_vector(T @ _turned(rng.normal(0.0, _SIGMA, size), rng.normal(0.0, _SIGMA, 2 * size - 3)))
