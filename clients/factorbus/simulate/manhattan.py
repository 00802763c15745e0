"""Streets of a grid, driven with odometry and with closures of loops at places seen before."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from random import Random

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.simulate.noise import diagonal_information, noisy_se2, relative_se2
from factorbus.simulate.parameters import checked_at_least, checked_run, checked_share, checked_sigma
from factorbus.simulate.step import BLOCK, POSE, FactorBlock, Step, steps_of
from factorbus.simulate.walk import GridPose, walk_streets

_VISITS = 2  # visits a place remembers: the first, for loops over the whole drive, and the last


@dataclass(frozen=True, slots=True)
class LoopClosures:
    """Which loops a drive closes.  Raises BadParameter.

    share: the share of poses that look for a place within radius_m (metres) which they passed gap or more poses ago;
    most: closures that such a pose finds at most.
    """

    share: float = 0.5
    most: int = 2
    radius_m: float = 2.0
    gap: int = 40

    def __post_init__(self) -> None:
        checked_share("LoopClosures.share", self.share)
        checked_at_least("LoopClosures.most", self.most, 0)
        checked_at_least("LoopClosures.radius_m", self.radius_m, 0)
        checked_at_least("LoopClosures.gap", self.gap, 2)


_USUAL = LoopClosures()


def manhattan(
    poses: int = 3500,
    seed: int = 1,
    *,
    sigma_xy_m: float = 0.0225,
    sigma_theta_rad: float = 0.0225,
    loops: LoopClosures = _USUAL,
    block_m: int = 5,
) -> Iterator[Step]:
    """A drive on a grid of streets: `se2` poses a metre apart, `between_se2` odometry and loop closures.

    Noise is independent in x, y (metres) and theta (radians).  Without arguments, densities and noise are like those
    of the manhattan3500 data set.  Raises BadParameter.
    """
    checked_run(poses, seed)
    checked_sigma("sigma_xy_m", sigma_xy_m)
    checked_sigma("sigma_theta_rad", sigma_theta_rad, 0.5)
    checked_at_least("block_m", block_m, 1)
    places = walk_streets(Random(f"streets {seed}"), block_m, straight=0.5)
    closures = _Closures(Random(f"closures {seed}"), loops)
    sigmas = np.array([sigma_xy_m, sigma_xy_m, sigma_theta_rad])
    return islice(_blocks(places, closures, np.random.default_rng([seed, 1]), sigmas), poses)


def _blocks(places: Iterator[GridPose], closures: "_Closures", rng: np.random.Generator, sigmas: F64) -> Iterator[Step]:
    first, before = 0, None
    while True:
        block = list(islice(places, BLOCK))
        pairs, starts, ends = [], [], []
        for number, place in enumerate(block, first):
            if before is not None:
                pairs.append((number - 1, number))
                starts.append(before)
            for partner, where in closures.found_from(number, place):
                pairs.append((partner, number))
                starts.append(where)
            ends.append(len(pairs))
            before = place
        truth = true_poses(block)
        ids = np.array(pairs, np.int64)
        T = relative_se2(true_poses(starts), truth[ids[:, 1] - first])
        z = noisy_se2(T, rng.normal(size=T.shape) * sigmas)
        edges = FactorBlock("between_se2", POSE + ids, z, diagonal_information(sigmas, len(z)), np.array(ends))
        yield from steps_of("se2", first, truth, [edges])
        first += len(block)


def true_poses(places: list[GridPose]) -> F64:
    """Poses (n, 3) of places; headings in [-π, π)."""
    table = np.array(places, float).reshape(-1, 3)
    table[:, 2] = ((table[:, 2] + 2) % 4 - 2) * (math.pi / 2)
    return table


class _Closures:
    """Remembers what a closure needs: per place of the grid its first and last visit."""

    def __init__(self, chance: Random, loops: LoopClosures) -> None:
        self._chance, self._loops, radius = chance, loops, loops.radius_m
        reach = range(-int(radius), int(radius) + 1)
        self._around = [(dx, dy) for dx in reach for dy in reach if dx * dx + dy * dy <= radius * radius]
        self._visits: dict[tuple[int, int], list[tuple[int, int]]] = {}

    def found_from(self, number: int, place: GridPose) -> list[tuple[int, GridPose]]:
        """Earlier poses that pose `number` recognizes, with their places; `number` is remembered from now on."""
        x, y, heading = place
        found: list[tuple[int, GridPose]] = []
        if self._chance.random() < self._loops.share:
            latest = number - self._loops.gap
            for dx, dy in self._around:
                for visitor, turned in self._visits.get((x + dx, y + dy), ()):
                    if visitor <= latest:
                        found.append((visitor, (x + dx, y + dy, turned)))
            found = self._some(found)
        visits = self._visits.setdefault((x, y), [])
        del visits[_VISITS - 1 :]
        visits.append((number, heading))
        return found

    def _some(self, found: list[tuple[int, GridPose]]) -> list[tuple[int, GridPose]]:
        """At most `most` of those found, by chance, oldest first; no pose twice."""
        picked: list[tuple[int, GridPose]] = []
        while found and len(picked) < self._loops.most:
            picked.append(found.pop(int(self._chance.random() * len(found))))
        return sorted(picked)
