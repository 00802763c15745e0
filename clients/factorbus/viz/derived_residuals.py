"""Residuals of kinds that another one becomes with further variables, of many factors at once (MATH §3.8, §3.9)."""

from collections.abc import Callable, Mapping

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.kinds import FACTOR_KINDS, FactorKind

Residual = Callable[..., F64]
Compose = Callable[[F64, F64], F64]


def derived_residual(kind: FactorKind, of: Residual, compose: Compose) -> Residual:
    """The residual of a kind by that of its base kind, called as residual(values of each variable (m, ·)..., z (m, ·)).

    compose: (a, b) -> a ∘ b of poses (m, ·) in the kind's space.
    """
    base = FACTOR_KINDS[kind.base]
    count, dim = len(base.connects), 2 if base.connects[0] == "se2" else 3
    is_pose = [end == base.connects[0] for end in base.connects]

    def residual(*ends_and_z: F64) -> F64:
        *ends, z = ends_and_z
        further = dict(zip(kind.modifiers, ends[count:], strict=True))
        inner = _inner(further, z, base.size, dim)
        z = _measured(further, z, base.size, dim)
        seen = []
        for end, pose in zip(ends[:count], is_pose, strict=True):
            if pose and inner is not None:
                end = compose(end, inner)
            if pose and "frame" in further:
                end = compose(further["frame"], end)
            seen.append(end)
        r = of(*seen, z)
        return r + further["bias"][:, :1] if "bias" in further else r

    return residual


def _inner(further: Mapping[str, F64], z: F64, size: int, dim: int) -> F64 | None:
    """The sensor's pose on the robot, or where the robot is after the offset; None: at the robot's pose."""
    if "mount" in further:
        return further["mount"]
    if "offset" not in further:
        return None
    way = z[:, size:] * further["offset"][:, :1]
    return _exp_se2(way) if dim == 2 else _exp_se3(way)


def _measured(further: Mapping[str, F64], z: F64, size: int, dim: int) -> F64:
    """What the base kind measures."""
    if "arm" in further:
        return np.column_stack([z, further["arm"][:, :dim]])
    z = z[:, :size]
    if "scale" in further:
        return np.column_stack([z[:, :dim] * further["scale"][:, :1], z[:, dim:]])
    return z


def _quotients(angle: F64) -> tuple[F64, F64]:
    """((1 − cos α)/α², (α − sin α)/α³), by their series where α is small."""
    small = angle < 1e-3
    alpha, square = np.where(small, 1.0, angle), angle * angle
    b = np.where(small, 0.5 - square / 24, (1 - np.cos(alpha)) / alpha**2)
    return b, np.where(small, 1 / 6 - square / 120, (alpha - np.sin(alpha)) / alpha**3)


def _exp_se2(way: F64) -> F64:
    """Exp of (v δ, ω δ) (m, 3)."""
    ux, uy, turn = way.T
    b, c = _quotients(np.abs(turn))
    along, across = 1 - c * turn * turn, b * turn
    return np.column_stack([along * ux - across * uy, across * ux + along * uy, turn])


def _exp_se3(way: F64) -> F64:
    """Exp of (v δ, ω δ) (m, 6), as x y z qx qy qz qw."""
    u, turn = way[:, :3], way[:, 3:]
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    b, c = _quotients(angle)
    across = np.cross(turn, u)
    half = 0.5 * np.sinc(angle / (2 * np.pi))
    return np.column_stack([u + b * across + c * np.cross(turn, across), half * turn, np.cos(angle / 2)])
