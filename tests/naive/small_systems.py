"""Small systems of every shape, solved: for processes that run the kernels slowly, checked or uncompiled."""

import numpy as np
from naive.block_systems import grid, random_system

from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze


def check() -> float:
    """The largest residual of some solves."""
    systems = [
        grid(9),
        grid(4, 6),
        random_system(1, [2, 3, 6, 1, 7, 3], [(0, 1), (1, 2), (3, 5), (0, 5)]),
        random_system(2, [6] * 12, [(i, j) for i in range(12) for j in range(i + 1, 12)]),
        random_system(3, [3] * 30, [(v, v + 1) for v in range(29)]),
        random_system(4, [], []),
    ]
    worst, cholesky = 0.0, Cholesky()
    for system in systems:
        group = np.arange(len(system.dims)) // 20
        symbolic = analyze(system.dims, system.rows, system.cols, order(system.dims, system.rows, system.cols, group))
        if cholesky.factorize(symbolic, system.data, system.offsets, 0.01) != -1:
            return np.inf
        damped = system.dense() + 0.01 * np.diag(np.diag(system.dense()))
        eta = np.arange(1.0, symbolic.size + 1.0)
        worst = max(worst, np.abs(damped @ cholesky.solve(eta) - eta).max(initial=0.0))
    return worst
