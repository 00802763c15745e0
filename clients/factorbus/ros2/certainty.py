"""Covariances as robots send them, made into information that a map can use.

Three rules. What cannot be a covariance (not finite, not symmetric, a negative variance) is refused with its message.
An axis with a variance of 10¹² or more is not known: drivers send 10³⁰⁸ or the largest double for that.  It is taken as
σ = 1 km, or σ = π, without correlation to the others.  What is too certain is floored: no direction may be more certain
than a floor f, standard deviations per axis. With D = diag(f) and the eigenvalues of D⁻¹ Σ D⁻¹ raised to at least 1,
Σ' = D (…) D. So zeros, which many drivers send, count as the floor, a singular covariance becomes one that can be
inverted, and what is larger stays as it is.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.ros2.problems import BadRosMessage

_ROUNDING = 1e-6
# From this variance on an axis is not known, and what is taken then: σ in metres and radians.
UNKNOWN = 1e12
_UNKNOWN_M, _UNKNOWN_RAD = 1e3, math.pi
_UNKNOWN_VARIANCE = np.array([_UNKNOWN_M**2] * 3 + [_UNKNOWN_RAD**2] * 3)
# Of an information matrix without units, smallest eigenvalue by largest: a map takes 1e-14.
_LEAST_SHARE = 1e-12
_AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True, slots=True)
class Checked:
    """A covariance (6, 6) that can be one, zero in the axes that do not count and in those that are `unknown`."""

    known: F64
    unknown: tuple[int, ...] = ()

    @property
    def spread(self) -> F64:
        """What is taken for the unknown axes (6, 6)."""
        made = np.zeros((6, 6))
        for axis in self.unknown:
            made[axis, axis] = _UNKNOWN_VARIANCE[axis]
        return made

    @property
    def whole(self) -> F64:
        """Of all axes."""
        return self.known + self.spread

    def remark(self) -> str:
        """What was done with it, for a person; empty: it was taken as it came."""
        if not self.unknown:
            return ""
        axes = ", ".join(_AXES[axis] for axis in self.unknown)
        return (
            f"a covariance with a variance of {UNKNOWN:g} or more in {axes}; taken as not known: "
            f"a standard deviation of {_UNKNOWN_M:g} m or {_UNKNOWN_RAD:.2f} rad"
        )


def unknown_motion() -> F64:
    """The covariance (6, 6) of a way of which nothing is known."""
    return np.diag(_UNKNOWN_VARIANCE)


def checked_covariance(topic: str, numbers: F64, axes: tuple[int, ...]) -> Checked:
    """The 6 × 6 covariance of a ROS message, of the axes that count.  Raises BadRosMessage."""
    made = _check(np.asarray(numbers, np.float64).tobytes(), axes)
    if isinstance(made, Checked):
        return made
    raise BadRosMessage(topic, *made)


@lru_cache(maxsize=256)
def _check(numbers: bytes, axes: tuple[int, ...]) -> Checked | tuple[str, str]:
    """The covariance, whose arrays are read-only, or (what was found, what is wanted).

    Kept, since most drivers send the same numbers with every message.
    """
    whole = np.frombuffer(numbers, np.float64).reshape(6, 6)
    if not np.isfinite(whole[np.ix_(axes, axes)]).all():
        return "a covariance that is not finite", "finite numbers"
    unknown = tuple(axis for axis in axes if whole[axis, axis] >= UNKNOWN)
    axes = tuple(axis for axis in axes if axis not in unknown)
    part = whole[np.ix_(axes, axes)]
    size = float(np.abs(part).max(initial=0.0))
    if size >= UNKNOWN:
        return f"a covariance with {size:.3g} off its diagonal", "less than its variances allow"
    if float(np.abs(part - part.T).max(initial=0.0)) > _ROUNDING * size:
        return "a covariance that is not symmetric", "a symmetric matrix"
    least = float(np.linalg.eigvalsh(part).min()) if size else 0.0
    if least < -_ROUNDING * size:
        return f"a covariance with the eigenvalue {least:.3g}", "none below zero"
    made = np.zeros((6, 6))
    made[np.ix_(axes, axes)] = 0.5 * (part + part.T)
    made.flags.writeable = False
    return Checked(made, unknown)


def floored(covariance: F64, floor: F64) -> F64:
    """Σ (d, d) nowhere more certain than `floor` (d,), standard deviations above zero."""
    whitened = covariance / np.outer(floor, floor)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    if values[0] >= 1.0:
        return covariance
    raised = (vectors * np.maximum(values, 1.0)) @ vectors.T
    return raised * np.outer(floor, floor)


def information(covariance: F64) -> F64:
    """Σ⁻¹ of a covariance with variances above zero: symmetric to the bit, and positive definite, as no direction
    counts as more certain than a map can tell from the others."""
    sigma = np.sqrt(covariance.diagonal())
    correlation = covariance / np.outer(sigma, sigma)
    values, vectors = np.linalg.eigh(0.5 * (correlation + correlation.T))
    inverse = (vectors / np.maximum(values, _LEAST_SHARE * values[-1])) @ vectors.T
    return 0.5 * (inverse + inverse.T) / np.outer(sigma, sigma)
