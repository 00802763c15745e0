"""The rows that a factor has in `fac`, and its variables.

A factor of n > 2 variables has a row for each pair of them, (0, 1), (0, 2), …, (0, n−1), (1, 2), …, with the blocks
of that pair in Λ.  So whatever follows from which variables are joined, such as order, fill, and which cliques a
factor changes, is the same for all factors.  The first row has the kind, the measurement and the loss, and the first
n − 1 rows name the variables.

Such factors, linear ones, and those of clients' own kinds are evaluated by `many`; their first row says how many
variables and numbers of a residual they have, and of an inertial one how many samples.
"""

from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.expression_layout import X_BEFORE
from factorbus.solver.kernels.model.imu_layout import ImuLayout, imu_layout, numbers_of_imu
from factorbus.solver.kernels.model.sizes import dim_of, information_at, residual_dim, size_of


@inline_kernel
def loss_code(f: int, fac: I64) -> int:
    """The code of the loss of factor f."""
    return fac[f, at.F_FLAGS] >> at.LOSS_SHIFT & at.LOSS_MASK


@inline_kernel
def is_one_of_many(f: int, fac: I64) -> bool:
    """Whether row f is of a factor that `many` evaluates: of more than two variables, linear, or own."""
    return fac[f, at.F_FLAGS] >> at.OFFSET_SHIFT != 0


@inline_kernel
def is_member(f: int, fac: I64) -> bool:
    """Whether row f is a further one of a factor that begins before it."""
    return fac[f, at.F_KIND] == at.MEMBER


@inline_kernel
def head_of(f: int, fac: I64) -> int:
    """The first row of the factor that row f is of."""
    return f - (fac[f, at.F_FLAGS] >> at.OFFSET_SHIFT & at.OFFSET_MASK)


@inline_kernel
def rows_of(f: int, fac: I64) -> int:
    """How many rows the factor has that begins at row f."""
    return rows_of_arity(fac[f, at.F_FLAGS] >> at.ENDS_SHIFT & at.ENDS_MASK)


@inline_kernel
def count_ends(f: int, fac: I64) -> int:
    """How many variables the factor has that begins at row f."""
    ends = fac[f, at.F_FLAGS] >> at.ENDS_SHIFT & at.ENDS_MASK
    if ends == 0:
        ends = 1 if fac[f, at.F_J] < 0 else 2
    return ends


@inline_kernel
def residual_size(f: int, fac: I64) -> int:
    """How many numbers the residual has of the factor that begins at row f; 0 of other rows."""
    own = fac[f, at.F_FLAGS] >> at.DIM_SHIFT
    return own if own != 0 else residual_dim(fac[f, at.F_KIND])


@inline_kernel
def form_of_imu(f: int, fac: I64) -> ImuLayout:
    """How the measurement of the inertial factor lies that begins at row f."""
    flags = fac[f, at.F_FLAGS]
    return imu_layout(flags >> at.SAMPLES_SHIFT & at.SAMPLES_MASK, flags & at.MOUNTED != 0, count_ends(f, fac))


@part
def information_start(f: int, var: I64, fac: I64, payload: F64) -> int:
    """Where in the payload the information begins of the factor that begins at row f, behind its measurement and what
    is kept with that."""
    start, kind = fac[f, at.F_AT], fac[f, at.F_KIND]
    if kind == at.OWN:
        return start + int(payload[start + X_BEFORE])
    if kind == at.IMU or kind == at.PREINTEGRATED:
        return start + numbers_of_imu(form_of_imu(f, fac))
    if kind != at.LINEAR:
        return start + information_at(kind)
    values = scalars = 0
    for n in range(count_ends(f, fac)):
        end = var[end_of(f, n, fac), at.V_KIND]
        values, scalars = values + size_of(end), scalars + dim_of(end)
    return start + values + residual_size(f, fac) * (scalars + 1)


@inline_kernel
def end_of(f: int, n: int, fac: I64) -> int:
    """The n-th variable of the factor that begins at row f."""
    return fac[f, at.F_I] if n == 0 else fac[f + n - 1, at.F_J]


@inline_kernel
def row_of_pair(f: int, a: int, b: int, ends: int) -> int:
    """The row of the variables a < b of the factor that begins at row f."""
    return f + a * (2 * ends - a - 1) // 2 + b - a - 1


@inline_kernel
def rows_of_arity(ends: int) -> int:
    """How many rows a factor of that number of variables has."""
    return ends * (ends - 1) // 2 if ends > 2 else 1
