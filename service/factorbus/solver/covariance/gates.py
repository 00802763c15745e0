"""How far off a measurement may be and still be believed: the quantiles of χ²."""

import numpy as np
from scipy.special import chdtri

from factorbus.solver.kernels.jit.compile import F64, I64


def threshold(dims: I64, probability: float) -> F64:
    """The d² that right measurements of this dimension stay below with `probability`, above 0 and below 1."""
    return np.asarray(chdtri(dims.astype(float), 1.0 - probability), float)
