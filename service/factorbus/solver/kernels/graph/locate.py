"""Where columns are in memory: one call for those of a group, since NumPy takes two microseconds to tell for each.

Columns that a message holds are read-only; a signature that fits saves the time to find one that will do.
"""

from factorbus.solver.kernels.jit.array_table import address_of
from factorbus.solver.kernels.jit.compile import F64, I64, kernel


@kernel(
    "UniTuple(int64, 2)(int64[::1], float64[:,::1])",
    "UniTuple(int64, 2)(Array(int64, 1, 'C', readonly=True), Array(float64, 2, 'C', readonly=True))",
)
def locate_variables(keys: I64, values: F64) -> tuple:
    """The addresses of keys (n,) and values (n, size)."""
    return address_of(keys), address_of(values)


@kernel(
    "UniTuple(int64, 3)(int64[:,::1], float64[:,::1], float64[:,::1])",
    "UniTuple(int64, 3)(Array(int64, 2, 'C', readonly=True), Array(float64, 2, 'C', readonly=True),"
    " Array(float64, 2, 'C', readonly=True))",
)
def locate_factors(keys: I64, measured: F64, information: F64) -> tuple:
    """The addresses of keys (m, arity), measured (m, size) and information (m, triangle)."""
    return address_of(keys), address_of(measured), address_of(information)


@kernel(
    "int64(int64[::1])",
    "int64(float64[::1])",
    "int64(Array(int64, 1, 'C', readonly=True))",
    "int64(Array(float64, 1, 'C', readonly=True))",
)
def locate_column(column: I64 | F64) -> int:
    """The address of time stamps (n,), keys (n,) or scales (m,)."""
    return address_of(column)
