"""Cholesky of a small dense matrix, and the forward substitution with it."""

import math

from factorbus.solver.kernels.jit.compile import F64, part


@part
def cholesky(size: int, M: F64, z: F64) -> int:
    """M := R with RᵀR = M, z := R⁻ᵀ z; gives the scalar whose pivot failed, or −1."""
    for i in range(size):
        pivot = M[i, i]
        for k in range(i):
            pivot -= M[k, i] * M[k, i]
        # what is new may have no other row to lean on: its pivot is compared with what it began with
        if not (pivot > 1e-13 * M[i, i] and pivot < math.inf):
            return i
        M[i, i] = math.sqrt(pivot)
        for j in range(i + 1, size):
            total = M[i, j]
            for k in range(i):
                total -= M[k, i] * M[k, j]
            M[i, j] = total / M[i, i]
        total = z[i]
        for k in range(i):
            total -= M[k, i] * z[k]
        z[i] = total / M[i, i]
    return -1
