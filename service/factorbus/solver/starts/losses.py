"""Weights of factors with losses, found while a linear problem is solved again and again.  MATH §12.4.

A loss that forgives all from the start would forgive what is right: so its scale is first as wide as the worst factor
is off, and narrows from round to round to what it is.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.dispatch import check_same

ROUNDS = 5


def _huber(s: F64, scale: F64) -> F64:
    return scale / np.sqrt(np.maximum(s, scale * scale))


def _cauchy(s: F64, scale: F64) -> F64:
    return scale * scale / (scale * scale + s)


def _geman_mcclure(s: F64, scale: F64) -> F64:
    return _cauchy(s, scale) ** 2


def _tukey(s: F64, scale: F64) -> F64:
    return np.maximum(1.0 - s / (scale * scale), 0.0) ** 2


def _dcs(s: F64, scale: F64) -> F64:
    return np.where(s > scale * scale, (2.0 * _cauchy(s, scale)) ** 2, 1.0)


# ρ'(s) of a factor with s = rᵀ Ω r, by its loss.  (3.9) to (3.13)
WEIGHTS = {"huber": _huber, "cauchy": _cauchy, "geman-mcclure": _geman_mcclure, "tukey": _tukey, "dcs": _dcs}
check_same("weight by loss", at.LOSS_CODES, WEIGHTS, __name__)


def weights_of(loss: I64, s: F64, scale: F64) -> F64:
    """ρ'(s) of each factor with s = rᵀ Ω r, by the code of its loss."""
    weights = np.ones(s.size)
    for name, code in at.LOSS_CODES.items():
        has = loss == code
        weights[has] = WEIGHTS[name](s[has], scale[has])
    return np.maximum(weights, 1e-6)


def narrowing(loss: I64, s: F64, scale: F64) -> list[float]:
    """How many times its own each scale is in each round: the first forgives nobody, the last is by itself."""
    robust = loss != at.NO_LOSS
    widest = max(float((s[robust] / scale[robust] ** 2).max(initial=1.0)), 1.0)
    return [widest ** (0.5 * left / ROUNDS) for left in range(ROUNDS - 1, -1, -1)]
