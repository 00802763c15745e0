"""Drives of a robot in the plane or in space, and the measurements made on them.

Poses are rows: (x, y, θ), or (x, y, z, qx, qy, qz, qw).
"""

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
from bench.replays.columns import F64
from bench.replays.compose import compose_se2, compose_se3, inverse_se2, inverse_se3
from scipy.spatial.transform import Rotation

from factorbus.proto.messages import Batch, Factors, Variables

Chance = np.random.Generator


@dataclass(frozen=True, slots=True)
class Motion:
    """What differs between plane and space.

    sigmas: of odometry and of relative poses; weak: of a prior that says little.
    """

    kind: str
    sigmas: tuple[float, ...]
    weak: tuple[float, ...]

    @property
    def between(self) -> str:
        """The kind of a relative pose."""
        return f"between_{self.kind}"

    @property
    def position(self) -> str:
        """The kind of a position in the map."""
        return f"position_{self.kind}"

    @abstractmethod
    def turn(self, chance: Chance, radians: float, still: bool = False) -> F64:
        """A pose that turns by so much; still: about any axis, else it is that of a step ahead of a metre."""

    @abstractmethod
    def compose(self, a: F64, b: F64) -> F64:
        """a b."""

    @abstractmethod
    def inverse(self, a: F64) -> F64:
        """a⁻¹."""

    @abstractmethod
    def small(self, r: F64) -> F64:
        """The pose whose residual against the identity is `r`."""

    def walk(self, chance: Chance, poses: int) -> F64:
        """A drive from the identity, a metre a step, that turns now and then."""
        rows = [self.compose(self.inverse(start := self.turn(chance, 0.0)), start)]
        while len(rows) < poses:
            angle = float(chance.normal() * (0.6 if chance.random() < 0.2 else 0.05))
            rows.append(self.compose(rows[-1], self.turn(chance, angle)))
        return np.array(rows)

    def far(self, chance: Chance, least_m: float, most_m: float, least_deg: float, most_deg: float) -> F64:
        """A pose that is so far off, and turned by so much, either way."""
        angle = np.radians(chance.uniform(least_deg, most_deg)) * chance.choice([-1.0, 1.0])
        pose = self.turn(chance, float(angle), still=True)
        direction = chance.normal(size=3)[: 2 if self.kind == "se2" else 3]
        pose[: len(direction)] = direction / np.linalg.norm(direction) * chance.uniform(least_m, most_m)
        return pose

    def carried(self, by: F64, poses: F64) -> F64:
        """All of them, moved as a whole."""
        return np.array([self.compose(by, pose) for pose in poses])

    def measured(self, chance: Chance, a: F64, b: F64) -> F64:
        """b as seen from a, with noise of `sigmas`."""
        relative = self.compose(self.inverse(a), b)
        return self.compose(relative, self.inverse(self.small(chance.normal(size=len(self.sigmas)) * self.sigmas)))

    def pose(self, chance: Chance, letter: int, i: int, truth: F64, prior: tuple[float, ...] | None = None) -> Batch:
        """The i-th pose with its odometry; the first one is held at the identity, or has this prior there."""
        key = np.array([letter + i])
        if i:
            z = self.measured(chance, truth[i - 1], truth[i])
            edge = between(self.between, letter + i - 1, letter + i, z, self.sigmas)
            return Batch((Variables(self.kind, key),), (edge,))
        start = self.small(np.zeros(len(self.sigmas)))
        if prior is None:
            return Batch((Variables(self.kind, key, start[None], True),))
        held = factor(f"prior_{self.kind}", [letter], start, prior)
        return Batch((Variables(self.kind, key, start[None]),), (held,))


class _Plane(Motion):
    __slots__ = ()

    def turn(self, chance: Chance, radians: float, still: bool = False) -> F64:
        return np.array([0.0 if still else 1.0, 0.0, radians])

    def compose(self, a: F64, b: F64) -> F64:
        return compose_se2(a, b)

    def inverse(self, a: F64) -> F64:
        return inverse_se2(a)

    def small(self, r: F64) -> F64:
        return np.array(r, float)


class _Space(Motion):
    __slots__ = ()

    def turn(self, chance: Chance, radians: float, still: bool = False) -> F64:
        axis = chance.normal(size=3) * (1.0 if still else np.array([0.1, 0.3, 1.0]))
        turned = Rotation.from_rotvec(axis / np.linalg.norm(axis) * radians).as_quat()
        return np.array([0.0 if still else 1.0, 0.0, 0.0, *turned])

    def compose(self, a: F64, b: F64) -> F64:
        return compose_se3(a, b)

    def inverse(self, a: F64) -> F64:
        return inverse_se3(a)

    def small(self, r: F64) -> F64:
        return np.array([*r, np.sqrt(max(1.0 - r[3:] @ r[3:], 0.0))])


PLANE = _Plane("se2", (0.05, 0.05, 0.02), (10.0, 10.0, 1.0))
SPACE = _Space("se3", (0.05, 0.05, 0.05, 0.01, 0.01, 0.01), (10.0, 10.0, 10.0, 0.5, 0.5, 0.5))


def between(kind: str, i: int, j: int, z: F64, sigmas: tuple[float, ...]) -> Factors:
    """One relative pose."""
    return factor(kind, [i, j], z, sigmas)


def factor(kind: str, ends: list[int], z: F64, sigmas: tuple[float, ...]) -> Factors:
    """One factor whose residual has these standard deviations."""
    information = np.diag(np.array(sigmas) ** -2.0)[np.triu_indices(len(sigmas))]
    return Factors(kind, np.array([ends]), np.array(z, float)[None], information[None])
