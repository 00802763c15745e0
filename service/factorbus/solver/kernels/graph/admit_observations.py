"""Can a camera have seen what is said that it saw?  Asked when an observation comes in.  MATH §3.1."""

import math

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.camera import observation
from factorbus.solver.kernels.model.factor_rows import is_one_of_many
from factorbus.solver.kernels.model.kinds import is_camera, lens_at, lens_is_variable
from factorbus.solver.kernels.model.many import linearize_many
from factorbus.solver.kernels.model.records import Ends
from factorbus.solver.lenses.layout import GOOD, VERTICAL
from factorbus.solver.lenses.models import ray

_VERTICAL = 1e-6


@kernel("UniTuple(int64, 2)(boolean, int64, int64, int64[:,::1], int64[:,::1], float64[::1], float64[::1])")
def find_lost(new: bool, f0: int, f1: int, var: I64, fac: I64, values: F64, payload: F64) -> tuple:
    """(the first observation of factors f0 .. f1−1 that has no pixel at `values`, and why); or (−1, GOOD).

    new: it has to be possible as well: a ray through the pixel where the lens is known, and of a first observation one
    that has an azimuth
    """
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    for f in range(f0, f1):
        kind = fac[f, at.F_KIND]
        if is_camera(kind) and is_one_of_many(f, fac):
            known = new and not lens_is_variable(kind)
            status = status_of_pixel(kind, payload, fac[f, at.F_AT]) if known else GOOD
            if status == GOOD:
                _, many = linearize_many(f, var, fac, values, payload)
                status = int(many.r[at.R_STATUS])
            if status != GOOD:
                return f, status
        elif is_camera(kind):
            x, y, p = var[fac[f, at.F_I], at.V_AT], var[fac[f, at.F_J], at.V_AT], fac[f, at.F_AT]
            status = status_of_pixel(kind, payload, p) if new else GOOD
            if status == GOOD:
                observation(kind, values, Ends(x, y), payload, p, r, A, B)
                status = int(r[at.R_STATUS])
            if status == GOOD and new and kind == at.IDP_FIRST and abs(math.cos(values[y + 4])) < _VERTICAL:
                status = VERTICAL
            if status != GOOD:
                return f, status
    return -1, GOOD


@inline_kernel
def status_of_pixel(kind: int, payload: F64, p: int) -> int:
    """GOOD where a ray belongs to the measured pixel."""
    n = p + lens_at(kind)
    status, _, _, _, _, _, _, _, _, _ = ray(int(payload[n]), payload[n + 1 :], payload[p], payload[p + 1])
    return int(status)
