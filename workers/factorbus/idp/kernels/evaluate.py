"""One factor or variable at a time, for those who are not a kernel: tests, and whoever looks at a single residual."""

from factorbus.idp.kernels.compile import F64, kernel
from factorbus.idp.kernels.factors import first_value, idp_first, idp_seen, move_idp, point_seen

IDP_FIRST, IDP_SEEN, POINT_SEEN = 0, 1, 2


@kernel("int64(int64, float64[::1], int64, int64, float64[::1], float64[::1], float64[:,::1], float64[:,::1])")
def evaluate(kind: int, x: F64, i: int, j: int, p: F64, r: F64, A: F64, B: F64) -> int:
    """Residual and Jacobians of one factor of `kind`: r (6,), A and B (6, 6), upper left corners filled."""
    if kind == IDP_FIRST:
        return idp_first(x, i, j, p, 0, r, A, B)
    if kind == IDP_SEEN:
        return idp_seen(x, i, j, p, 0, r, A, B)
    return point_seen(x, i, j, p, 0, r, A, B)


@kernel("int64(float64[::1], int64, float64[::1], float64[::1])")
def first(x: F64, i: int, p: F64, y: F64) -> int:
    """The feature y (6,) of a first sight p from the pose at i; gives a status."""
    return first_value(x, i, p, 0, y, 0)


@kernel("void(float64[::1], float64[::1], float64[::1])")
def moved(y: F64, step: F64, out: F64) -> None:
    """out = y ⊞ step, all (6,)."""
    move_idp(y, 0, step, 0, out)
