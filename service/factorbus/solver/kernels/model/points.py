"""Points in the plane and in space, and vectors: ⊞, and priors of points.  MATH §2.3, (3.8).  Arguments as in `se2`."""

from factorbus.solver.kernels.jit.compile import F64, inline_kernel


@inline_kernel
def prior_point2(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = x − z,  A = I."""
    r[0], r[1] = x[i] - p[k], x[i + 1] - p[k + 1]
    A[0, 0], A[0, 1] = 1.0, 0.0
    A[1, 0], A[1, 1] = 0.0, 1.0


@inline_kernel
def prior_point3(x: F64, i: int, _j: int, p: F64, k: int, r: F64, A: F64, _B: F64) -> None:
    """r = x − z,  A = I."""
    r[0], r[1], r[2] = x[i] - p[k], x[i + 1] - p[k + 1], x[i + 2] - p[k + 2]
    A[0, 0], A[0, 1], A[0, 2] = 1.0, 0.0, 0.0
    A[1, 0], A[1, 1], A[1, 2] = 0.0, 1.0, 0.0
    A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0


@inline_kernel
def move_point2(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x + δ."""
    out[i], out[i + 1] = x[i] + step[d], x[i + 1] + step[d + 1]


@inline_kernel
def move_point3(x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x + δ."""
    out[i], out[i + 1], out[i + 2] = x[i] + step[d], x[i + 1] + step[d + 1], x[i + 2] + step[d + 2]


@inline_kernel
def move_vector(n: int, x: F64, i: int, step: F64, d: int, out: F64) -> None:
    """out = x + δ, of n numbers."""
    for c in range(n):
        out[i + c] = x[i + c] + step[d + c]
