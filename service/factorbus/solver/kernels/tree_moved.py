"""What a step of the tree moved, and the way back."""

import numpy as np

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels._jit import F64, I64, inline_kernel, kernel, part
from factorbus.solver.kernels.sizes import size_of


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
        if v < first and differs_in_tree(v, var, lin, values):
            out[n] = v
            n += 1
    return n


@inline_kernel
def differs_in_tree(v: int, var: I64, lin: I64, values: I64) -> bool:
    """Whether a value has other bits than in lin[2]."""
    x, differs = var[v, at.V_AT], False
    for a in range(size_of(var[v, at.V_KIND])):
        differs |= lin[2, x + a] != values[x + a]
    return differs


@part
def count_differing(first: int, count: int, changed: I64, var: I64, lin: F64, values: F64) -> int:
    """How many `list_moved` would list."""
    n, before, now = count - first, lin.view(np.int64), values.view(np.int64)
    for k in range(changed.size):
        if changed[k] < first and differs_in_tree(changed[k], var, before, now):
            n += 1
    return n


@kernel("void(int64[::1], int64[:,::1], float64[:,::1], float64[::1])")
def exchange(changed: I64, var: I64, lin: F64, values: F64) -> None:
    """Exchange the values of the changed variables and those from before the step."""
    for k in range(changed.size):
        x = var[changed[k], at.V_AT]
        for a in range(size_of(var[changed[k], at.V_KIND])):
            lin[2, x + a], values[x + a] = values[x + a], lin[2, x + a]
