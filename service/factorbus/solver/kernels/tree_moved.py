"""What a step of the tree moved, and the way back."""

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64, kernel
from factorbus.solver.kernels.reach import size_of


@kernel("int64(int64, int64, int64[::1], int64[:,::1], int64[:,::1], int64[::1], int64[::1])")
def list_moved(first: int, count: int, changed: I64, var: I64, lin: I64, values: I64, out: I64) -> int:
    """List in `out` the variables `first` .. count−1, and those of `changed` whose bits are not those of lin[2].

    lin and values are given as the integers that their bits are, so that −0.0 is not 0.0.  Gives how many.
    """
    n = 0
    for v in range(first, count):
        out[n] = v
        n += 1
    for k in range(changed.size):
        v = changed[k]
        x, moved = var[v, at.V_AT], False
        for a in range(size_of(var[v, at.V_KIND])):
            moved |= lin[2, x + a] != values[x + a]
        if moved and v < first:
            out[n] = v
            n += 1
    return n


@kernel("void(int64[::1], int64[:,::1], float64[:,::1], float64[::1])")
def exchange(changed: I64, var: I64, lin: F64, values: F64) -> None:
    """Exchange the values of the changed variables and those from before the step."""
    for k in range(changed.size):
        x = var[changed[k], at.V_AT]
        for a in range(size_of(var[changed[k], at.V_KIND])):
            lin[2, x + a], values[x + a] = values[x + a], lin[2, x + a]
