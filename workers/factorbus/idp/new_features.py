"""From pixels to features: checks at the door, then the kernel.  MATH §3, §4."""

from typing import NamedTuple

import numpy as np

from factorbus.idp.kernels import layout as at
from factorbus.idp.kernels import rays as kernels
from factorbus.idp.kernels.compile import F64
from factorbus.idp.lenses import camera_model
from factorbus.proto.features import CAMERA_STATE, FEATURE, BadPixel, BadState, Observations
from factorbus.proto.problems import BadShape

_REASONS = {
    at.NOT_FINITE: "not a finite number",
    at.OUTSIDE_LENS: "beyond where the lens model is one to one: no ray belongs to it",
    at.OUTSIDE_IMAGE: "outside the image",
    at.VERTICAL: "its ray runs along the world's y axis, where azimuth has no meaning",
}
# As in maps: beyond these, squares are lost to rounding or overflow, and the answer would have infinities.
_LARGEST, _LEAST_SIGMA, _LARGEST_COVARIANCE = 1e12, 1e-12, 1e24
# P may be asymmetric by rounding, not by meaning.
_ASYMMETRY = 1e-9


class Seen(NamedTuple):
    """Features and how they move.

    y (n, 6): x y z (metres), θ, φ (radians), ρ (1/metre).
    turn (n, 4): tan φ sin θ, tan φ cos θ, cos θ, sin θ, of which G = ∂(θ, φ)/∂δ is made (3.2).
    slope (n, 4): M = ∂(θ, φ)/∂(u, v), radians per pixel, row by row (3.4).
    """

    y: F64
    turn: F64
    slope: F64


def see(observations: Observations) -> Seen:
    """The features of `observations`.  Raises BadShape, BadState, BadPixel: then nothing is computed for any."""
    _check(observations)
    n = observations.count
    seen = Seen(np.empty((n, FEATURE)), np.empty((n, 4)), np.empty((n, 4)))
    status = np.empty(n, np.int64)
    state, pixels = contiguous(observations.state), contiguous(observations.pixels)
    kernels.features_of_pixels(camera_model(observations.camera), state, float(observations.rho), pixels, *seen, status)
    if status.any():
        first = int(np.flatnonzero(status)[0])
        u, v = pixels[first].tolist()
        raise BadPixel(first, u, v, _REASONS[int(status[first])])
    return seen


def jacobians(observations: Observations, seen: Seen) -> tuple[F64, F64]:
    """A = ∂y/∂x_v (n, 6, 13) and B = ∂y/∂h_d (n, 6, 3), h_d = (u, v, ρ).  MATH (4.1), (4.2)"""
    n = len(seen.y)
    A, B = np.empty((n, FEATURE, CAMERA_STATE)), np.empty((n, FEATURE, 3))
    kernels.feature_jacobians(contiguous(observations.state), seen.turn, seen.slope, A, B)
    return A, B


def padd(observations: Observations) -> F64:
    """Padd (3, 3): the covariance of (u, v, ρ) of one feature.  MATH (5.1)"""
    return np.diag([observations.sigma_pixel**2, observations.sigma_pixel**2, observations.sigma_rho**2])


def contiguous(array: F64) -> F64:
    """`array` as kernels take it: a copy where it is read-only, not aligned or not contiguous."""
    return array if array.flags.carray and array.dtype == np.float64 else np.array(array, np.float64, order="C")


def _check(observations: Observations) -> None:
    for name, array, wanted in (
        ("state", observations.state, (CAMERA_STATE,)),
        ("covariance", observations.covariance, (CAMERA_STATE, -1)),
        ("pixels", observations.pixels, (-1, 2)),
    ):
        if array.ndim != len(wanted) or any(w not in (-1, s) for w, s in zip(wanted, array.shape, strict=True)):
            shape = " × ".join("n" if w < 0 else str(w) for w in wanted)
            raise BadShape(f"observations.{name}", " × ".join(map(str, array.shape)), shape)
    if observations.width < CAMERA_STATE:
        raise BadShape("observations.covariance", f"13 × {observations.width}", "13 × m with m ≥ 13, the camera first")
    _check_prior(observations)
    if not np.isfinite(observations.state).all() or not np.linalg.norm(observations.state[3:7]) > 1e-6:
        raise BadState(
            "state", str(observations.state.tolist())[:120], "13 finite numbers with a quaternion q0 qx qy qz"
        )
    if (largest := float(np.abs(observations.state).max())) > _LARGEST:
        raise BadState("state", f"as large as {largest:.3g}", f"numbers up to {_LARGEST:g} in magnitude")
    own = observations.covariance[:, :CAMERA_STATE]
    if not np.isfinite(observations.covariance).all():
        raise BadState("covariance", "not finite everywhere", "finite numbers")
    if (largest := float(np.abs(observations.covariance).max())) > _LARGEST_COVARIANCE:
        raise BadState(
            "covariance", f"as large as {largest:.3g}", f"numbers up to {_LARGEST_COVARIANCE:g} in magnitude"
        )
    if not (np.diag(own) >= 0.0).all():
        raise BadState("covariance", f"negative on its diagonal: {np.diag(own).min():.3g}", "variances")
    if (worst := abs(own - own.T).max()) > _ASYMMETRY * abs(own).max():
        raise BadState("covariance", f"asymmetric by {worst:.3g}", "the first 13 rows of a symmetric P")


def _check_prior(observations: Observations) -> None:
    if not abs(observations.rho) <= _LARGEST:
        raise BadState("rho", observations.rho, f"an inverse distance, 1/metre, up to {_LARGEST:g} in magnitude")
    for name in ("sigma_rho", "sigma_pixel"):
        sigma = getattr(observations, name)
        if not _LEAST_SIGMA <= sigma <= _LARGEST:
            raise BadState(name, sigma, f"a standard deviation from {_LEAST_SIGMA:g} to {_LARGEST:g}")
