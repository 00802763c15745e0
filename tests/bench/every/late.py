"""Positions that come late by way of something else: ranges to anchors, and GNSS in a frame that is to be found out.

As `hard.late_positions`, of the same sizes, but here no factor of one variable tells where the robot is.
"""

from collections.abc import Iterator

import numpy as np
from bench.replays.columns import F64

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

from .hard import X
from .motion import SPACE, Chance, Motion, factor

ANCHOR, FRAME = symbol("a", 0), symbol("f", 0)
_SIGMA = 0.1  # metres, of a range and of a position
_REACH_M = 40.0  # how far anchors are from the middle of what is measured, along each axis


def late_ranges(motion: Motion, poses: int, seed: int) -> Iterator[Batch]:
    """A drive whose prior is weak, and wrong by 90° to 170° and 10 to 21 m, as ranges to anchors tell from a pose
    between the 30th and the middle on: to three to five fixed points in the plane, one more in space."""
    chance = np.random.default_rng([seed, 15])
    first, period, weak = _when(chance, motion, poses)
    truth = motion.carried(motion.far(chance, 10.0, 21.0, 90.0, 170.0), motion.walk(chance, poses))
    size = _size(motion)
    count = size + int(chance.integers(1, 4))
    anchors = truth[first:, :size].mean(axis=0) + chance.uniform(-_REACH_M, _REACH_M, (count, size))
    for i in range(poses):
        batch = motion.pose(chance, X, i, truth, prior=weak)
        if i == first:
            fixed = Variables(f"point{size}", ANCHOR + np.arange(count), anchors, True)
            batch = Batch((*batch.variables, fixed), batch.factors)
        if i >= first and (i - first) % period == 0:
            batch = Batch(batch.variables, (*batch.factors, _ranges(chance, motion, i, truth[i, :size], anchors)))
        yield batch


def _ranges(chance: Chance, motion: Motion, i: int, place: F64, anchors: F64) -> Factors:
    """From the i-th pose to all anchors."""
    count = len(anchors)
    z = np.abs(np.linalg.norm(anchors - place, axis=1) + chance.normal(size=count) * _SIGMA)
    keys = np.stack((np.full(count, X + i), ANCHOR + np.arange(count)), axis=1)
    return Factors(f"range_{motion.kind}", keys, z[:, None], np.full((count, 1), _SIGMA**-2))


def late_frames(motion: Motion, poses: int, seed: int) -> Iterator[Batch]:
    """A drive that GNSS measures from a pose between the 30th and the middle on, in a frame in which the map is turned
    by 90° to 170° and 10 to 21 m off: a weak prior says that it is not.

    The first pose is held, or has a prior that is not as weak as that of the frame may be: with 100 times the σ of
    both, what turns map and frame against each other has hardly an optimum that differences find.
    """
    chance = np.random.default_rng([seed, 16])
    first, period, weak = _when(chance, motion, poses)
    held = bool(chance.random() < 0.5)
    frame = motion.far(chance, 10.0, 21.0, 90.0, 170.0)
    truth, size = motion.walk(chance, poses), _size(motion)
    measured, start = motion.carried(frame, truth)[:, :size], motion.small(np.zeros(len(weak)))
    for i in range(poses):
        batch = motion.pose(chance, X, i, truth, prior=None if held else motion.weak)
        if i == first:
            believed = factor(f"prior_{motion.kind}", [FRAME], start, weak)
            place = Variables(motion.kind, np.array([FRAME]), start[None])
            batch = Batch((*batch.variables, place), (*batch.factors, believed))
        if i >= first and (i - first) % period == 0:
            z = np.concatenate([measured[i] + chance.normal(size=size) * _SIGMA, np.zeros(size)])
            seen = factor(f"{motion.position}_frame", [X + i, FRAME], z, (_SIGMA,) * size)
            batch = Batch(batch.variables, (*batch.factors, seen))
        yield batch


def _when(chance: Chance, motion: Motion, poses: int) -> tuple[int, int, tuple[float, ...]]:
    """The first pose that is measured, every how many, and the standard deviations of a prior."""
    first = int(chance.integers(30, max(poses // 2, 31)))
    period, weakness = int(chance.choice([1, 5, 10])), float(chance.choice([1.0, 100.0]))
    return first, period, tuple(weakness * sigma for sigma in motion.weak)


def _size(motion: Motion) -> int:
    return 3 if motion is SPACE else 2
