"""How certain a measurement is, as a front end says it: checked, and brought into the form of the wire."""

from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from factorbus.proto.arrays import F64
from factorbus.proto.kinds import LOSSES
from factorbus.proto.problems import BadInformation, BadLoss, BadShape

# How far an information matrix may be from symmetric, relative to its largest entry: rounding, not meaning.
_ASYMMETRY = 1e-9


class Certainty(TypedDict, total=False):
    """How certain a measurement is: one of the two.

    sigmas (r,): standard deviations in the units and order of the residual.
    information: the inverse covariance, a symmetric (r, r) matrix or its upper triangle (r(r+1)/2,) row by row.
    The rotation part of an se3 residual is the vector part of a quaternion, so half an angle: for a standard
    deviation of s radians say s/2.
    loss: what it counts where it is far off, ("huber", 1.345) say: one of `factorbus.proto.kinds.LOSSES` and its scale,
    standard deviations.
    """

    sigmas: ArrayLike
    information: ArrayLike
    loss: tuple[str, float] | None


def triangle_of(where: str, dim: int, certainty: Certainty) -> F64:
    """The upper triangle of Ω, dim × dim.  Raises BadShape, BadInformation."""
    sigmas, information = certainty.get("sigmas"), certainty.get("information")
    if (sigmas is None) == (information is None):
        raise BadInformation(where, "both or neither of sigmas and information", "one of the two")
    if information is None:
        return _from_sigmas(where, dim, np.array(sigmas, np.float64))
    return _from_matrix(where, dim, np.array(information, np.float64))


def carried(where: str, dim: int, certainty: Certainty, A: F64) -> Certainty:
    """The certainty of r' where this is that of r = A r'."""
    W = full(triangle_of(where, dim, certainty), dim)
    return {"information": (A.T @ W @ A)[np.triu_indices(dim)], "loss": certainty.get("loss")}


def full(triangle: F64, dim: int) -> F64:
    """The symmetric matrix with this upper triangle."""
    W = np.zeros((dim, dim))
    W[np.triu_indices(dim)] = triangle
    return W + np.triu(W, 1).T


def loss_of(where: str, loss: tuple[str, float] | None) -> tuple[str, float]:
    """(name, scale); ("", 0) for none."""
    if loss is None:
        return "", 0.0
    name, scale = loss
    if name not in LOSSES:
        raise BadLoss(where, repr(name), f"one of {', '.join(LOSSES)}")
    if not (np.isfinite(scale) and scale > 0.0):
        raise BadLoss(where, f"the scale {scale!r}", "a finite number above 0, standard deviations")
    return name, float(scale)


def _from_sigmas(where: str, dim: int, sigmas: F64) -> F64:
    if sigmas.shape != (dim,):
        raise BadShape(f"{where}: sigmas", f"shape {sigmas.shape}", f"({dim},)")
    if not (np.isfinite(sigmas).all() and (sigmas > 0).all()):
        raise BadInformation(f"{where}: sigmas", sigmas.tolist(), "positive finite numbers")
    return np.diag(1.0 / sigmas**2)[np.triu_indices(dim)]


def _from_matrix(where: str, dim: int, matrix: F64) -> F64:
    if matrix.shape == (dim * (dim + 1) // 2,):
        return matrix
    if matrix.shape != (dim, dim):
        wanted = f"({dim}, {dim}), or ({dim * (dim + 1) // 2},) for its upper triangle row by row"
        raise BadShape(f"{where}: information", f"shape {matrix.shape}", wanted)
    with np.errstate(invalid="ignore"):  # what is not finite the service refuses, with its place
        worst = np.abs(matrix - matrix.T).max()
    if worst > _ASYMMETRY * np.abs(matrix).max():
        raise BadInformation(f"{where}: information", f"asymmetric by {worst:g}", "a symmetric matrix")
    return matrix[np.triu_indices(dim)]
