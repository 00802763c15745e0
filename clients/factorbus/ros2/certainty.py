"""Covariances as robots send them, made into information that a map can use.

Two rules. What cannot be a covariance (not finite, not symmetric, a negative variance) is refused with its message.
What is too certain is floored: no direction may be more certain than a floor f, standard deviations per axis. With
D = diag(f) and the eigenvalues of D⁻¹ Σ D⁻¹ raised to at least 1, Σ' = D (…) D. So zeros, which many drivers send,
count as the floor, a singular covariance becomes one that can be inverted, and what is larger stays as it is.
"""

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.ros2.problems import BadRosMessage

_ROUNDING = 1e-6


def checked(topic: str, numbers: F64, axes: tuple[int, ...]) -> F64:
    """The 6 × 6 covariance of a ROS message, of the axes that count; the others are zero.  Raises BadRosMessage."""
    whole = np.asarray(numbers, np.float64).reshape(6, 6)
    part = whole[np.ix_(axes, axes)]
    if not np.isfinite(part).all():
        raise BadRosMessage(topic, "a covariance that is not finite", "finite numbers")
    size = float(np.abs(part).max())
    if float(np.abs(part - part.T).max()) > _ROUNDING * size:
        raise BadRosMessage(topic, "a covariance that is not symmetric", "a symmetric matrix")
    least = float(np.linalg.eigvalsh(part).min()) if size else 0.0
    if least < -_ROUNDING * size:
        raise BadRosMessage(topic, f"a covariance with the eigenvalue {least:.3g}", "none below zero")
    made = np.zeros((6, 6))
    made[np.ix_(axes, axes)] = 0.5 * (part + part.T)
    return made


def floored(covariance: F64, floor: F64) -> F64:
    """Σ (d, d) nowhere more certain than `floor` (d,), standard deviations above zero."""
    whitened = covariance / np.outer(floor, floor)
    values, vectors = np.linalg.eigh(0.5 * (whitened + whitened.T))
    if values[0] >= 1.0:
        return covariance
    raised = (vectors * np.maximum(values, 1.0)) @ vectors.T
    return raised * np.outer(floor, floor)


def information(covariance: F64) -> F64:
    """Σ⁻¹, symmetric to the bit."""
    inverse = np.linalg.inv(covariance)
    return 0.5 * (inverse + inverse.T)
