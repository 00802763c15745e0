"""How certain a measurement is, as a front end says it: checked, and brought into the form of the wire."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Required, TypedDict

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import as_numbers
from factorbus.proto.arrays import F64
from factorbus.proto.kinds import FACTOR_KINDS, LOSSES
from factorbus.proto.nearest import nearest
from factorbus.proto.problems import BadInformation, BadLoss, BadShape

# How far an information matrix may be from symmetric, relative to its largest entry: rounding, not meaning.
_ASYMMETRY = 1e-9

# Scales of losses given by name alone, standard deviations.  Those of huber, cauchy and tukey keep 95 % of the
# efficiency of least squares where one number is measured and its noise is Gaussian.
DEFAULT_SCALES = types.MappingProxyType(
    {"huber": 1.345, "cauchy": 2.3849, "geman-mcclure": 1.0, "tukey": 4.6851, "dcs": 1.0}
)

# What others call it, and what is near it here.
_ELSEWHERE = types.MappingProxyType(
    {
        "covariance": "information",
        "cov": "information",
        "noise": "sigmas",
        "std": "sigmas",
        "stddev": "sigmas",
        "robust": "loss",
        "kernel": "loss",
        "huber": "loss",
        "cauchy": "loss",
        "tukey": "loss",
        "dcs": "loss",
    }
)


class Certainty(TypedDict, total=False):
    """How certain a measurement is: sigmas or information, and a loss if wanted.

    sigmas (r,): standard deviations, one for each number of the residual: metres, and radians also for rotations in
    space (they are converted to g2o's half angles).  One number will do where the residual has one.
    information: the inverse covariance of the residual as the wire has it, a symmetric (r, r) matrix or its upper
    triangle (r(r+1)/2,) row by row; the rotation rows of `prior_se3` and `between_se3` are half angles, so an
    information of 1/s² of an angle in radians is 4/s² there.
    loss: what it counts where it is far off: ("huber", 1.345), a name of `factorbus.proto.kinds.LOSSES` and its scale
    in standard deviations; the name alone has the scale of DEFAULT_SCALES.
    trusted: it is not tested where the map tests loop closures, as odometry is not.
    """

    sigmas: ArrayLike
    information: ArrayLike
    loss: tuple[str, float] | str | None
    trusted: bool


class FeatureCertainty(TypedDict, total=False):
    """How certain the first observation of an inverse-depth feature is.

    sigma_rho: of the inverse distance, 1/metre; without a default.  sigma_pixel: of u and of v, pixels (1.0).
    sigma_anchor: how well the feature's anchor is held to the pose, metres (1e-4).  loss: as in `Certainty`.
    """

    sigma_rho: Required[float]
    sigma_pixel: float
    sigma_anchor: float
    loss: tuple[str, float] | str | None


def feature_sigmas(where: str, certainty: FeatureCertainty) -> list[float]:
    """Standard deviations (6,) of the residual of `idp_first`: anchor, pixel, 1/distance.  Raises BadInformation."""
    wanted = tuple(FeatureCertainty.__annotations__)
    for name in certainty:
        if name not in wanted:
            raise BadInformation(where, f"there is no keyword {name!r}", f"{', '.join(wanted)}{nearest(name, wanted)}")
    if "sigma_rho" not in certainty:
        raise BadInformation(where, "no sigma_rho", "sigma_rho, the standard deviation of rho in 1/metre")
    pixel, anchor = certainty.get("sigma_pixel", 1.0), certainty.get("sigma_anchor", 1e-4)
    return [anchor] * 3 + [pixel] * 2 + [certainty["sigma_rho"]]


def triangle_of(where: str, dim: int, certainty: Certainty, kind: str = "") -> F64:
    """The upper triangle of Ω, dim × dim, of a factor of `kind`.  Raises BadShape, BadInformation."""
    check_names(where, certainty)
    sigmas, information = certainty.get("sigmas"), certainty.get("information")
    if sigmas is not None and information is None:
        return _from_sigmas(where, dim, np.atleast_1d(as_numbers(f"{where}: sigmas", sigmas)), kind)
    if information is not None and sigmas is None:
        return _from_matrix(where, dim, as_numbers(f"{where}: information", information))
    seen = "neither sigmas nor information" if sigmas is None else "both sigmas and information"
    raise BadInformation(where, seen, "one of the two: how certain it is")


def transform_certainty(where: str, dim: int, certainty: Certainty, A: F64, kind: str) -> Certainty:
    """The certainty of r' where this is that of r = A r', both of a factor of `kind`."""
    W = full(triangle_of(where, dim, certainty, kind), dim)
    made: Certainty = {"information": (A.T @ W @ A)[np.triu_indices(dim)], "loss": certainty.get("loss")}
    if "trusted" in certainty:
        made["trusted"] = certainty["trusted"]
    return made


def inverted(where: str, covariance: ArrayLike, certainty: Mapping[str, object]) -> Certainty:
    """The information that a covariance is the inverse of.  Raises BadInformation, BadShape."""
    if certainty.get("sigmas") is not None or certainty.get("information") is not None:
        raise BadInformation(where, "a covariance, and sigmas or information", "one of the three: how certain it is")
    matrix = as_numbers(f"{where}: covariance", covariance)
    if matrix.shape != (3, 3):
        raise BadShape(f"{where}: covariance", f"shape {matrix.shape}", "(3, 3)")
    if not (np.isfinite(matrix).all() and np.linalg.eigvalsh(matrix + matrix.T)[0] > 0.0):
        raise BadInformation(f"{where}: covariance", repr(matrix.tolist())[:80], "a positive definite matrix")
    information = np.linalg.inv(matrix)
    return {"information": (information + information.T) / 2.0}


def full(triangle: F64, dim: int) -> F64:
    """The symmetric matrix with this upper triangle."""
    W = np.zeros((dim, dim))
    W[np.triu_indices(dim)] = triangle
    return W + np.triu(W, 1).T


def loss_of(where: str, loss: tuple[str, float] | str | None) -> tuple[str, float]:
    """(name, scale); ("", 0) for none.  Raises BadLoss."""
    if loss is None:
        return "", 0.0
    name, scale = _parts(where, loss)
    if name == "none":
        return "", 0.0
    if name not in LOSSES:
        raise BadLoss(where, f"the loss {name!r}", f"none, or one of {', '.join(LOSSES)}{nearest(name, LOSSES)}")
    scale = DEFAULT_SCALES[name] if scale is None else scale
    if isinstance(scale, bool) or not isinstance(scale, (int, float, np.number)):
        raise BadLoss(where, f"the scale {scale!r}", "a finite number above 0, standard deviations")
    if not (np.isfinite(scale) and scale > 0.0):
        raise BadLoss(where, f"the scale {scale!r}", "a finite number above 0, standard deviations")
    return str(name), float(scale)


def _parts(where: str, loss: object) -> tuple[object, object]:
    if isinstance(loss, str):
        return loss, None
    if not isinstance(loss, (tuple, list)) or len(loss) != 2:
        raise BadLoss(where, f"the loss {loss!r}", 'a name and a scale, such as ("huber", 1.345), or a name alone')
    return loss[0], loss[1]


def check_names(where: str, certainty: Mapping[str, object], of: type = Certainty) -> None:
    """A misspelt keyword must not be a loss or a weight ignored.  Raises BadInformation: `of` has no such keyword."""
    wanted = tuple(of.__annotations__)
    for name in certainty:
        if name not in wanted:
            meant = f"; did you mean {_ELSEWHERE[name]!r}?" if name in _ELSEWHERE else nearest(name, wanted)
            if name.startswith("cov"):
                meant += " It is the inverse of the covariance of the residual; or give sigmas"
            raise BadInformation(where, f"there is no keyword {name!r}", f"{', '.join(wanted)}{meant}")


def _from_sigmas(where: str, dim: int, sigmas: F64, kind: str) -> F64:
    if sigmas.shape != (dim,):
        seen = "one number" if sigmas.shape == (1,) else f"shape {sigmas.shape}"
        raise BadShape(f"{where}: sigmas", seen, f"({dim},), one for each number of the residual{_rows(kind, dim)}")
    if not (np.isfinite(sigmas).all() and (sigmas > 0).all()):
        raise BadInformation(f"{where}: sigmas", sigmas.tolist(), "positive finite numbers")
    if kind in FACTOR_KINDS and FACTOR_KINDS[kind].half_angles:
        halves = np.ones(dim)
        halves[FACTOR_KINDS[kind].half_angle_rows] = 0.5
        sigmas = sigmas * halves
    with np.errstate(over="ignore", divide="ignore", under="ignore"):
        information = 1.0 / sigmas**2
    if not (np.isfinite(information).all() and (information > 0).all()):
        raise BadInformation(f"{where}: sigmas", sigmas.tolist(), "numbers whose squares a double has, 1e-150 to 1e150")
    return np.diag(information)[np.triu_indices(dim)]


def _rows(kind: str, dim: int) -> str:
    """What the numbers of a residual are, where a kind has that in a table."""
    known = FACTOR_KINDS.get(kind)
    if known is None or known.own or known.is_linear or dim == 1:
        return ""
    turns = "; of rotations in radians about x y z" if known.half_angles else ""
    return f", r = {known.residual}{turns}"


def _from_matrix(where: str, dim: int, matrix: F64) -> F64:
    is_triangle = matrix.shape == (dim * (dim + 1) // 2,)
    if not is_triangle and matrix.shape != (dim, dim):
        wanted = f"({dim}, {dim}), or ({dim * (dim + 1) // 2},) for its upper triangle row by row"
        raise BadShape(f"{where}: information", f"shape {matrix.shape}", wanted)
    if not np.isfinite(matrix).all():
        raise BadInformation(f"{where}: information", repr(matrix.tolist())[:80], "finite numbers")
    if is_triangle:
        return matrix
    worst = np.abs(matrix - matrix.T).max()
    if worst > _ASYMMETRY * np.abs(matrix).max():
        raise BadInformation(f"{where}: information", f"asymmetric by {worst:g}", "a symmetric matrix")
    return matrix[np.triu_indices(dim)]
