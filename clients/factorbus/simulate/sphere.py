"""A spiral over a sphere and back, with odometry and closures to the ring below and to the pass before."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from random import Random

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.simulate.noise import diagonal_information, noisy_se3, quaternion_product, relative_se3
from factorbus.simulate.parameters import checked_at_least, checked_run, checked_share, checked_sigma
from factorbus.simulate.step import BLOCK, POSE, FactorBlock, Step, steps_of


@dataclass(frozen=True, slots=True)
class Spiral:
    """A way over a sphere: `rings` turns with `ring` poses each, on a radius in metres.  Raises BadParameter."""

    ring: int = 50
    rings: int = 50
    radius_m: float = 50.0

    def __post_init__(self) -> None:
        checked_at_least("Spiral.ring", self.ring, 3)
        checked_at_least("Spiral.rings", self.rings, 1)
        checked_sigma("Spiral.radius_m", self.radius_m)


_USUAL = Spiral()


def sphere(
    poses: int = 2500,
    seed: int = 1,
    *,
    sigma_xyz_m: float = 0.1,
    sigma_rotation_rad: float = 0.02,
    loop_share: float = 1.0,
    revisit_share: float = 0.1,
    spiral: Spiral = _USUAL,
) -> Iterator[Step]:
    """A spiral over a sphere, up and down again: `se3` poses, `between_se3`.

    loop_share: the share of poses with an edge to the pose one turn earlier; revisit_share: from the second pass on,
    the share with an edge to the last pose at the same place.  x points along the way (east), z away from the
    centre.  sigma_rotation_rad is the standard deviation of the rotation vector about each axis; the information
    sent is that of the quaternion's vector part, which is half of it.  Without arguments, densities and noise are like
    those of the sphere2500 data set.  Raises BadParameter.
    """
    checked_run(poses, seed)
    checked_sigma("sigma_xyz_m", sigma_xyz_m)
    checked_sigma("sigma_rotation_rad", sigma_rotation_rad, 0.25)
    checked_share("loop_share", loop_share)
    checked_share("revisit_share", revisit_share)
    way = _Way(spiral)
    sigmas = np.array([sigma_xyz_m] * 3 + [sigma_rotation_rad / 2] * 3)
    chance = Random(f"closures {seed}")
    return islice(_blocks(way, chance, loop_share, revisit_share, np.random.default_rng([seed, 3]), sigmas), poses)


def _blocks(
    way: "_Way", chance: Random, loop_share: float, revisit_share: float, rng: np.random.Generator, sigmas: F64
) -> Iterator[Step]:
    first = 0
    while True:
        pairs, ends = [], []
        for number in range(first, first + BLOCK):
            partners = [number - 1] if number else []
            below, before = way.ring_below(number), way.pass_before(number)
            if below >= 0 and chance.random() < loop_share:
                partners.append(below)
            if before >= 0 and chance.random() < revisit_share:
                partners.append(before)
            pairs += [(partner, number) for partner in partners]
            ends.append(len(pairs))
        ids = np.array(pairs, np.int64)
        T = relative_se3(way.poses(ids[:, 0]), way.poses(ids[:, 1]))
        z = noisy_se3(T, rng.normal(size=(len(T), 6)) * sigmas)
        edges = FactorBlock("between_se3", POSE + ids, z, diagonal_information(sigmas, len(z)), np.array(ends))
        yield from steps_of("se3", first, way.poses(np.arange(first, first + BLOCK)), [edges])
        first += BLOCK


class _Way:
    """Where pose k is: a function of k, so that nothing needs to be remembered.

    Places 0 .. ring·rings − 1 go from pole to pole; a pass visits all of them, the next one backwards.
    """

    def __init__(self, spiral: Spiral) -> None:
        self._ring, self._places, self._radius = spiral.ring, spiral.ring * spiral.rings, spiral.radius_m

    def ring_below(self, number: int) -> int:
        """The pose one turn of the spiral earlier in the same pass, or -1."""
        return number - self._ring if number % self._places >= self._ring else -1

    def pass_before(self, number: int) -> int:
        """The pose at the same place in the pass before, or -1; not the turning point itself."""
        since = number % self._places
        return number - 2 * since - 1 if number >= self._places and since > 0 else -1

    def poses(self, numbers: I64) -> F64:
        """Poses (n, 7) of the given numbers."""
        turn, since = np.divmod(numbers, self._places)
        backwards = turn % 2 == 1
        place = np.where(backwards, self._places - 1 - since, since)
        longitude = 2 * np.pi * place / self._ring
        latitude = np.pi * ((place + 0.5) / self._places - 0.5)
        up = np.stack(
            [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], axis=1
        )
        east_north_up = np.tile([0.5, 0.5, 0.5, 0.5], (len(numbers), 1))  # at longitude 0, latitude 0: x→y→z→x
        quat = quaternion_product(_about("z", longitude), quaternion_product(_about("y", -latitude), east_north_up))
        quat = quaternion_product(quat, _about("z", np.where(backwards, np.pi, 0.0)))
        return np.concatenate([self._radius * up, np.where(quat[:, 3:] < 0, -quat, quat)], axis=1)


def _about(axis: str, angle: F64) -> F64:
    quat = np.zeros((len(angle), 4))
    quat[:, "xyz".index(axis)] = np.sin(angle / 2)
    quat[:, 3] = np.cos(angle / 2)
    return quat
