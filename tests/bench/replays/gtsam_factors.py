"""Our factors as GTSAM's, as near as its wheel has them; what differs is said in `isam2`."""

import math
from collections.abc import Callable, Iterator
from typing import Any

import gtsam
import numpy as np

from factorbus.proto.messages import Factors

from .columns import F64, symmetric
from .contestants import Failed

_TIGHT = 1e-4  # metres and radians of the prior that holds the first pose; nothing pulls at it
_RADTAN = 1.0  # the code of lenses with and without such distortion
_HALVES = np.array([1, 1, 1, 0.5, 0.5, 0.5])


def gtsam_factors(group: Factors, as_gtsam_reads: bool = False) -> Iterator[Any]:
    """One by one.  as_gtsam_reads: the information of relative poses in space as GTSAM's reader of g2o files has it.

    Raises Failed for a kind or a loss that the wheel has not.
    """
    make = _between_se3_as_read if as_gtsam_reads and group.kind == "between_se3" else _FACTORS.get(group.kind)
    if make is None:
        raise Failed(f"no factor for {group.kind} in GTSAM's wheel")
    if group.loss and group.loss not in _LOSSES:
        raise Failed(f"no loss like {group.loss} in GTSAM's wheel")
    rows = zip(group.keys.tolist(), group.measured, symmetric(group.information), strict=True)
    for n, (ends, z, information) in enumerate(rows):
        factor = make(*ends, z, information)
        if group.loss and group.scale is not None:
            loss = _LOSSES[group.loss].Create(float(group.scale[n]))
            factor = factor.cloneWithNewNoiseModel(gtsam.noiseModel.Robust.Create(loss, factor.noiseModel()))
        yield factor


def held(kind: str, key: int, values: Any, sigma: float = _TIGHT) -> Any:
    """A prior that holds a pose, or a point, where it is, to `sigma` (metres, radians)."""
    if kind == "point2":
        return gtsam.PriorFactorPoint2(key, values.atPoint2(key), gtsam.noiseModel.Isotropic.Sigma(2, sigma))
    if kind == "point3":
        return gtsam.PriorFactorPoint3(key, values.atPoint3(key), gtsam.noiseModel.Isotropic.Sigma(3, sigma))
    if kind == "se2":
        return gtsam.PriorFactorPose2(key, values.atPose2(key), gtsam.noiseModel.Isotropic.Sigma(3, sigma))
    return gtsam.PriorFactorPose3(key, values.atPose3(key), gtsam.noiseModel.Isotropic.Sigma(6, sigma))


def pose3(value: F64) -> Any:
    """(x y z qx qy qz qw) as GTSAM's."""
    x, y, z, w = value[3:].tolist()
    return gtsam.Pose3(gtsam.Rot3.Quaternion(w, x, y, z), value[:3])


def _between_se2(i: int, j: int, z: F64, information: F64) -> Any:
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.BetweenFactorPose2(i, j, gtsam.Pose2(*z.tolist()), noise)


def _between_se3(i: int, j: int, z: F64, information: F64) -> Any:
    return _between_se3_as_read(i, j, z, information * np.outer(_HALVES, _HALVES))


def _between_se3_as_read(i: int, j: int, z: F64, information: F64) -> Any:
    noise = gtsam.noiseModel.Gaussian.Information(_rotation_first(information))
    return gtsam.BetweenFactorPose3(i, j, pose3(z), noise)


def _landmark_se2(i: int, j: int, z: F64, information: F64) -> Any:
    distance, bearing = math.hypot(z[0], z[1]), math.atan2(z[1], z[0])
    c, s = math.cos(bearing), math.sin(bearing)
    jacobian = np.array([[-s / distance, c / distance], [c, s]])
    covariance = jacobian @ np.linalg.inv(information) @ jacobian.T
    noise = gtsam.noiseModel.Gaussian.Covariance((covariance + covariance.T) / 2)
    return gtsam.BearingRangeFactor2D(i, j, gtsam.Rot2(bearing), distance, noise)


def _bearing_range_se2(i: int, j: int, z: F64, information: F64) -> Any:
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.BearingRangeFactor2D(i, j, gtsam.Rot2(float(z[0])), float(z[1]), noise)


def _bearing_se2(i: int, j: int, z: F64, information: F64) -> Any:
    noise = gtsam.noiseModel.Gaussian.Information(information)
    return gtsam.BearingFactor2D(i, j, gtsam.Rot2(float(z[0])), noise)


def _landmark_se3(i: int, j: int, z: F64, information: F64) -> Any:
    """As bearing and range with the covariance carried over: the wheel has no factor for a point from a pose."""
    distance, bearing = float(np.linalg.norm(z)), gtsam.Unit3(z)
    jacobian = np.vstack((bearing.basis().T / distance, z[None] / distance))
    covariance = jacobian @ np.linalg.inv(information) @ jacobian.T
    noise = gtsam.noiseModel.Gaussian.Covariance((covariance + covariance.T) / 2)
    return gtsam.BearingRangeFactor3D(i, j, bearing, distance, noise)


def _range(make: Callable[..., Any]) -> Callable[..., Any]:
    """A distance, as GTSAM's factor for the kinds of its ends."""

    def factor(i: int, j: int, z: F64, information: F64) -> Any:
        return make(i, j, float(z[0]), gtsam.noiseModel.Gaussian.Information(information))

    return factor


def _point_seen(i: int, j: int, z: F64, information: F64) -> Any:
    code, fx, fy, cx, cy = z[2:7].tolist()
    if code != _RADTAN or z[7:].any():
        raise Failed(f"a lens {z[2:].tolist()}: GTSAM's factor is made here for one without distortion")
    noise = gtsam.noiseModel.Gaussian.Information(information)
    camera = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    return gtsam.GenericProjectionFactorCal3_S2(z[:2].copy(), noise, i, j, camera)


def _prior_se2(i: int, z: F64, information: F64) -> Any:
    return gtsam.PriorFactorPose2(i, gtsam.Pose2(*z.tolist()), gtsam.noiseModel.Gaussian.Information(information))


def _prior_se3(i: int, z: F64, information: F64) -> Any:
    noise = gtsam.noiseModel.Gaussian.Information(_rotation_first(information * np.outer(_HALVES, _HALVES)))
    return gtsam.PriorFactorPose3(i, pose3(z), noise)


def _position_se2(i: int, z: F64, information: F64) -> Any:
    _check_no_lever(z[2:])
    return gtsam.PoseTranslationPrior2D(i, z[:2].copy(), gtsam.noiseModel.Gaussian.Information(information))


def _position_se3(i: int, z: F64, information: F64) -> Any:
    _check_no_lever(z[3:])
    return gtsam.GPSFactor(i, z[:3].copy(), gtsam.noiseModel.Gaussian.Information(information))


def _check_no_lever(lever: F64) -> None:
    if lever.any():
        raise Failed(f"a position with a lever {lever.tolist()}: GTSAM's factor is made here for one without")


def _rotation_first(information: F64) -> F64:
    order = [3, 4, 5, 0, 1, 2]
    return information[np.ix_(order, order)]


_LOSSES = {
    "huber": gtsam.noiseModel.mEstimator.Huber,
    "cauchy": gtsam.noiseModel.mEstimator.Cauchy,
    "dcs": gtsam.noiseModel.mEstimator.DCS,
    "geman-mcclure": gtsam.noiseModel.mEstimator.GemanMcClure,
    "tukey": gtsam.noiseModel.mEstimator.Tukey,
}
_FACTORS: dict[str, Callable[..., Any]] = {
    "between_se2": _between_se2,
    "between_se3": _between_se3,
    "landmark_se2": _landmark_se2,
    "landmark_se3": _landmark_se3,
    "bearing_range_se2": _bearing_range_se2,
    "bearing_se2": _bearing_se2,
    "range_se2": _range(gtsam.RangeFactor2D),
    "range_se3": _range(gtsam.RangeFactor3D),
    "range_between_se2": _range(gtsam.RangeFactorPose2),
    "range_between_se3": _range(gtsam.RangeFactorPose3),
    "point_seen": _point_seen,
    "prior_se2": _prior_se2,
    "prior_se3": _prior_se3,
    "position_se2": _position_se2,
    "position_se3": _position_se3,
}
