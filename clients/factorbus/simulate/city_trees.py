"""A town with a tree in some of its blocks, driven with odometry and observations of the trees."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from random import Random
from typing import Literal

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.simulate.manhattan import true_poses
from factorbus.simulate.noise import diagonal_information, noisy_se2, relative_se2, seen_from, wrapped
from factorbus.simulate.parameters import BadParameter, checked_at_least, checked_run, checked_share, checked_sigma
from factorbus.simulate.step import BLOCK, POINT, POSE, FactorBlock, PointBlock, Step, steps_of
from factorbus.simulate.walk import GridPose, walk_streets

_KERB_M = 1.0  # trees stand at least that far from the middle of the street


@dataclass(frozen=True, slots=True)
class TreeSensor:
    """What sees the trees.  Raises BadParameter.

    kind: "landmark_se2" (x, y in the frame of the pose; sigma_m each, metres) or "bearing_range_se2"
    (sigma_bearing_rad, radians, and sigma_m).  share: the share of trees within reach_m (metres) that a pose sees.
    """

    kind: Literal["landmark_se2", "bearing_range_se2"] = "landmark_se2"
    sigma_m: float = 0.1
    sigma_bearing_rad: float = 0.02
    share: float = 0.35
    reach_m: float = 8.0

    def __post_init__(self) -> None:
        if self.kind not in ("landmark_se2", "bearing_range_se2"):
            raise BadParameter("TreeSensor.kind", self.kind, "landmark_se2 or bearing_range_se2")
        checked_sigma("TreeSensor.sigma_m", self.sigma_m, _KERB_M / 8)  # so that no range is drawn below 0
        checked_sigma("TreeSensor.sigma_bearing_rad", self.sigma_bearing_rad, 0.5)
        checked_share("TreeSensor.share", self.share)
        checked_at_least("TreeSensor.reach_m", self.reach_m, _KERB_M)

    @property
    def sigmas(self) -> F64:
        """Standard deviations (2,) of a measurement, in its units."""
        return np.array([self.sigma_bearing_rad if self.kind == "bearing_range_se2" else self.sigma_m, self.sigma_m])


_USUAL = TreeSensor()


def city_trees(
    poses: int = 10000,
    seed: int = 1,
    *,
    sigma_xy_m: float = 0.02,
    sigma_theta_rad: float = 0.01,
    sensor: TreeSensor = _USUAL,
    tree_share: float = 0.2,
    block_m: int = 5,
) -> Iterator[Step]:
    """A drive past trees: `se2` poses a metre apart with `between_se2` odometry, `point2` trees, and observations.

    tree_share: the share of blocks with a tree.  Without arguments, densities and noise are like those of the
    citytrees10000 data set, with somewhat more observations.  Raises BadParameter.
    """
    checked_run(poses, seed)
    checked_sigma("sigma_xy_m", sigma_xy_m)
    checked_sigma("sigma_theta_rad", sigma_theta_rad, 0.5)
    checked_share("tree_share", tree_share)
    checked_at_least("block_m", block_m, 3)
    places = walk_streets(Random(f"streets {seed}"), block_m, straight=0.5)
    trees = _Trees(seed, tree_share, sensor, block_m)
    odometry = np.array([sigma_xy_m, sigma_xy_m, sigma_theta_rad])
    return islice(_blocks(places, trees, np.random.default_rng([seed, 2]), odometry, sensor), poses)


def _blocks(
    places: Iterator[GridPose], trees: "_Trees", rng: np.random.Generator, odometry: F64, sensor: TreeSensor
) -> Iterator[Step]:
    first, before = 0, None
    while True:
        block = list(islice(places, BLOCK))
        truth = true_poses(block)
        start = truth if before is None else np.concatenate([before, truth])  # the very first pose has no odometry
        T = relative_se2(start[:-1], start[1:])
        z = noisy_se2(T, rng.normal(size=T.shape) * odometry)
        numbers = np.arange(first + len(block) - len(z), first + len(block))
        pairs = POSE + np.stack([numbers - 1, numbers], axis=1)
        ends = np.arange(len(block)) + (len(z) == len(block))
        edges = FactorBlock("between_se2", pairs, z, diagonal_information(odometry, len(z)), ends)
        observations, points = _observations(trees, rng, first, block, truth, sensor)
        yield from steps_of("se2", first, truth, [edges, observations], points)
        first, before = first + len(block), truth[-1:]


def _observations(
    trees: "_Trees", rng: np.random.Generator, first: int, block: list[GridPose], truth: F64, sensor: TreeSensor
) -> tuple[FactorBlock, PointBlock]:
    known = trees.count
    seen, ends, new_ends = [], [], []
    for k, (x, y, _) in enumerate(block):
        seen += [(k, number, *where) for number, where in trees.seen_from(x, y)]
        ends.append(len(seen))
        new_ends.append(trees.count - known)
    table = np.array(seen, float).reshape(-1, 4)
    rows, numbers = table[:, 0].astype(np.int64), table[:, 1].astype(np.int64)
    exact = seen_from(truth[rows], table[:, 2:])
    if sensor.kind == "bearing_range_se2":
        exact = np.stack([np.arctan2(exact[:, 1], exact[:, 0]), np.hypot(exact[:, 0], exact[:, 1])], axis=1)
    z = exact - rng.normal(size=exact.shape) * sensor.sigmas
    if sensor.kind == "bearing_range_se2":
        z[:, 0] = wrapped(z[:, 0])
    keys = np.stack([POSE + first + rows, POINT + numbers], axis=1)
    points = PointBlock("point2", known, _new_trees(numbers, table[:, 2:], known, trees.count), np.array(new_ends))
    return FactorBlock(sensor.kind, keys, z, diagonal_information(sensor.sigmas, len(z)), np.array(ends)), points


def _new_trees(numbers: np.ndarray, where: F64, known: int, count: int) -> F64:
    """Places of the trees from `known` to `count`, each seen at least once."""
    places = np.empty((count - known, 2))
    new = numbers >= known
    places[numbers[new] - known] = where[new]
    return places


class _Trees:
    """Where the trees are (a matter of the seed and the block alone), and the numbers of those seen so far."""

    def __init__(self, seed: int, share: float, sensor: TreeSensor, block: int) -> None:
        self._seed, self._share, self._sensor, self._block = seed, share, sensor, block
        self._chance = Random(f"sightings {seed}")  # a seed: another text is another town
        self._planted: dict[tuple[int, int], tuple[float, float] | None] = {}
        self._numbers: dict[tuple[int, int], int] = {}

    @property
    def count(self) -> int:
        """Trees seen so far."""
        return len(self._numbers)

    def seen_from(self, x: int, y: int) -> list[tuple[int, tuple[float, float]]]:
        """Numbers and places of the trees seen from (x, y); new ones get the next numbers."""
        reach, block = self._sensor.reach_m, self._block
        columns = range(math.floor((x - reach) / block), math.floor((x + reach) / block) + 1)
        rows = range(math.floor((y - reach) / block), math.floor((y + reach) / block) + 1)
        seen = []
        for column in columns:
            for row in rows:
                tree = self._tree((column, row))
                if (
                    tree
                    and math.hypot(tree[0] - x, tree[1] - y) <= reach
                    and self._chance.random() < self._sensor.share
                ):
                    seen.append((self._numbers.setdefault((column, row), self.count), tree))
        return seen

    def _tree(self, tile: tuple[int, int]) -> tuple[float, float] | None:
        if tile not in self._planted:
            chance = Random(f"tree {self._seed} {tile[0]} {tile[1]}")
            free = self._block - 2 * _KERB_M
            stands = chance.random() < self._share
            place = tuple(self._block * corner + _KERB_M + free * chance.random() for corner in tile)
            self._planted[tile] = (place[0], place[1]) if stands else None
        return self._planted[tile]
