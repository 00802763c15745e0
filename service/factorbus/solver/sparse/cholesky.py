"""The numeric factorization RᵀR = PΛPᵀ and the solves with it, in arenas that are kept between calls."""

from collections.abc import Callable
from typing import Any

import numpy as np

from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.multifrontal import factorize
from factorbus.solver.kernels.sparse.triangular_solve import (
    into_elimination_order,
    into_insertion_order,
    solve_fronts,
    solve_fronts_transposed,
)
from factorbus.solver.sparse.ordering import integers
from factorbus.solver.sparse.pivots import least_pivot
from factorbus.solver.sparse.symbolic import Symbolic
from factorbus.solver.sparse.worker_threads import TASK_QUEUE
from factorbus.wording import counted

_LINE = 8  # doubles in a cache line


class Cholesky:
    """R of the last successful `factorize`, and the memory for the next one."""

    def __init__(self) -> None:
        self._symbolic: Symbolic | None = None
        self._arena, self._room = np.empty(0), np.empty(0)

    @property
    def arena(self) -> F64:
        """Where the fronts' numbers are; see `kernels/sparse/fronts.py`."""
        return self._arena

    def factorize(self, symbolic: Symbolic, data: F64, offsets: I64, damping: float = 0.0) -> int:
        """Factorize Λ with diagonal Λ·(1 + damping), block b row-major at data[offsets[b]:].

        Gives -1, or the variable whose pivot is not above `PIVOT_TOLERANCE` of its diagonal entry in Λ (or not a
        number): Λ is not positive definite there, or singular as far as doubles can tell.  Then there is no factor
        until the next successful call.  Raises ValueError when a block lies outside `data`.
        """
        self._symbolic = None
        data, offsets = np.require(data, float, ("C", "W")), integers(offsets)
        _check_blocks(symbolic, data, offsets)
        self._reserve(symbolic)
        failed = factorize(
            symbolic.fronts, symbolic.runs, symbolic.blocks, data, offsets, float(damping), self._arena, TASK_QUEUE
        )
        if failed >= 0:
            return symbolic.variable_at(failed)
        self._symbolic = symbolic
        return -1

    def take(self, symbolic: Symbolic, fill: Callable[[F64], int]) -> int:
        """R from elsewhere: `fill` writes it into the arena it is given, and gives what `factorize` does."""
        self._symbolic = None
        self._reserve(symbolic)
        failed = fill(self._arena)
        self._symbolic = symbolic if failed < 0 else None
        return failed

    def solve(self, eta: F64) -> F64:
        """δ with Λδ = η, both in insertion order of the scalars."""
        return self.back(self.forward(eta))

    def forward(self, eta: F64) -> F64:
        """d = R⁻ᵀPη, in elimination order."""
        symbolic, d = self._of(eta), np.empty(len(eta))
        into_elimination_order(symbolic.place, symbolic.starts, symbolic.dims, np.array(eta, float), d)
        solve_fronts_transposed(symbolic.fronts, symbolic.separator, self._arena, d, self._room)
        return d

    def back(self, d: F64) -> F64:
        """δ = PᵀR⁻¹d: from elimination order back to insertion order."""
        symbolic, x, delta = self._of(d), np.array(d, float), np.empty(len(d))
        solve_fronts(symbolic.fronts, symbolic.separator, self._arena, x, self._room)
        into_insertion_order(symbolic.place, symbolic.starts, symbolic.dims, x, delta)
        return delta

    def least_pivot(self) -> float:
        """The least R_kk²; infinite without any."""
        fronts = self._of(None).fronts
        return least_pivot(self._arena, fronts[:, fr.ROWS], fronts[:, fr.PIVOTS], fronts[:, fr.LD_ROWS])

    def R(self) -> Any:  # noqa: N802  (the paper's letter)
        """R as a scipy CSC array, upper triangular, rows and columns in elimination order (`scalar_order`)."""
        from scipy.sparse import coo_array, csc_array

        symbolic = self._of(None)
        rows, cols, values = [], [], []
        for front in symbolic.fronts:
            p, m, k = int(front[fr.PIVOTS]), int(front[fr.SEPARATOR]), int(front[fr.COLUMN])
            separator = symbolic.separator[front[fr.SEPARATOR_AT] : front[fr.SEPARATOR_AT] + m]
            columns = np.concatenate((np.arange(k, k + p), separator))
            for i in range(p):
                at = int(front[fr.ROWS] + i * front[fr.LD_ROWS])
                values.append(self._arena[at + i : at + p + m])
                cols.append(columns[i:])
                rows.append(np.full(p + m - i, k + i))
        entries = np.concatenate(values or [np.empty(0)])
        index = tuple(np.concatenate(part or [np.empty(0, np.int64)]) for part in (rows, cols))
        return csc_array(coo_array((entries, index), shape=(symbolic.size, symbolic.size)))

    def _of(self, vector: F64 | None) -> Symbolic:
        if self._symbolic is None:
            raise ValueError("there is no factor to solve with: the last factorize failed or there was none")
        if vector is not None and vector.shape != (self._symbolic.size,):
            raise ValueError(f"a vector of shape {vector.shape} was given to a system of {self._symbolic.size} scalars")
        return self._symbolic

    def _reserve(self, symbolic: Symbolic) -> None:
        """Arenas at least as large as needed; they grow by doubling and never shrink."""
        self._arena = _grown(self._arena, symbolic.arena)
        self._room = _grown(self._room, symbolic.widest)


def _check_blocks(symbolic: Symbolic, data: F64, offsets: I64) -> None:
    if len(offsets) != len(symbolic.areas):
        blocks = counted(len(symbolic.areas), "block")
        raise ValueError(f"{counted(len(offsets), 'offset')} for the {blocks} of the analysed pattern")
    least, end = offsets.min(initial=0), (offsets + symbolic.areas).max(initial=0)
    if least < 0 or end > data.size or data.ndim != 1:
        raise ValueError(f"blocks reach from {least} to {end} in data of shape {data.shape}")


def _grown(arena: F64, need: int) -> F64:
    if len(arena) >= need:
        return arena
    size = max(need, 2 * len(arena))
    raw = np.empty(size + _LINE)
    skip = (-raw.ctypes.data // 8) % _LINE
    return raw[skip : skip + size]
