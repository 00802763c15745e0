"""Weights of factors with losses, found while a linear problem is solved again and again.  MATH §12.4.

A loss that forgives all from the start would forgive what is right: so its scale is first as wide as the worst factor
is off, and narrows from round to round to what it is.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

ROUNDS = 5


def weights_of(loss: I64, s: F64, scale: F64) -> F64:
    """ρ'(s) of each factor with s = rᵀ Ω r.  (3.9) to (3.13)"""
    c = scale * scale
    share = c / (c + s)
    over = s > c
    weights = np.ones(s.size)
    for code, values in (
        (at.LOSS_CODES["huber"], np.where(over, scale / np.sqrt(np.maximum(s, c)), 1.0)),
        (at.LOSS_CODES["cauchy"], share),
        (at.LOSS_CODES["geman-mcclure"], share**2),
        (at.LOSS_CODES["tukey"], np.where(over, 0.0, 1.0 - np.minimum(s / c, 1.0)) ** 2),
        (at.LOSS_CODES["dcs"], np.where(over, (2.0 * share) ** 2, 1.0)),
    ):
        weights = np.where(loss == code, values, weights)
    return np.maximum(weights, 1e-6)


def narrowing(loss: I64, s: F64, scale: F64) -> list[float]:
    """How many times its own each scale is in each round: the first forgives nobody, the last is by itself."""
    robust = loss != at.NO_LOSS
    widest = max(float((s[robust] / scale[robust] ** 2).max(initial=1.0)), 1.0)
    return [widest ** (0.5 * left / ROUNDS) for left in range(ROUNDS - 1, -1, -1)]
