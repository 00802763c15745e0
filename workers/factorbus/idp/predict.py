"""What a filter predicts to see of its features, and what they are as points.  MATH §6."""

from typing import NamedTuple

import numpy as np

from factorbus.idp.kernels import layout as at
from factorbus.idp.kernels import pixels as kernels
from factorbus.idp.kernels.compile import F64, I64
from factorbus.idp.lenses import camera_model
from factorbus.idp.new_features import contiguous
from factorbus.proto.camera import Camera
from factorbus.proto.features import CAMERA_STATE, FEATURE
from factorbus.proto.problems import BadShape

# Why a feature has no pixel, by its status; 0 is a good one.
REASONS = {
    at.NOT_FINITE: "its pixel is not a finite number",
    at.OUTSIDE_LENS: "beyond where the lens model is one to one",
    at.OUTSIDE_IMAGE: "outside the image",
    at.BEHIND: "behind the camera",
}


class Predicted(NamedTuple):
    """Pixels of n features from one camera state.

    pixels (n, 2): distorted, u v.  by_state (n, 2, 13), by_feature (n, 2, 6): their Jacobians.
    status (n,): 0, or one of REASONS; the pixel of such a feature means nothing.
    """

    pixels: F64
    by_state: F64
    by_feature: F64
    status: I64


class Points(NamedTuple):
    """Features as points.

    p (n, 3): metres, world.  covariance (n, 3, 3): metres².  linearity (n,): below about 0.1 a point is as good a
    Gaussian as the feature (Civera, Davison and Montiel, 2008).
    """

    p: F64
    covariance: F64
    linearity: F64


def predict(camera: Camera, state: F64, y: F64) -> Predicted:
    """Pixels of the features y (n, 6) from camera state (13,).  Raises BadShape."""
    _check(state, y)
    n = len(y)
    seen = Predicted(np.empty((n, 2)), np.empty((n, 2, CAMERA_STATE)), np.empty((n, 2, FEATURE)), np.empty(n, np.int64))
    kernels.observe(camera_model(camera), contiguous(state), contiguous(y), *seen)
    return seen


def to_points(state: F64, y: F64, covariance: F64) -> Points:
    """The features y (n, 6) with covariance (n, 6, 6) as points, with their linearity from camera state (13,).

    Raises BadShape.
    """
    _check(state, y)
    n = len(y)
    if covariance.shape != (n, FEATURE, FEATURE):
        raise BadShape("covariance", " × ".join(map(str, covariance.shape)), f"{n} × 6 × 6")
    found = Points(np.empty((n, 3)), np.empty((n, 3, 3)), np.empty(n))
    work = np.empty((3, FEATURE))
    kernels.points(contiguous(state), contiguous(y), contiguous(covariance), work, *found)
    return found


def _check(state: F64, y: F64) -> None:
    if state.shape != (CAMERA_STATE,):
        raise BadShape("state", " × ".join(map(str, state.shape)), "13")
    if y.ndim != 2 or y.shape[1] != FEATURE:
        raise BadShape("y", " × ".join(map(str, y.shape)), "n × 6")
