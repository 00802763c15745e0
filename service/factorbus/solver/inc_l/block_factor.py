"""R and d in block rows, changed step by step: rows are appended, and those that new factors reach are updated.

The rows and their arenas are laid out in `kernels/inc_l/block_rows.py`.
"""

from dataclasses import dataclass

import numpy as np

from factorbus.solver.graph.arenas import Arenas, with_room
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.inc_l import block_rows as br
from factorbus.solver.kernels.inc_l.block_rows import (
    append_rows,
    compact_rows,
    reach_rows,
    solve_block_rows,
    solve_block_rows_transposed,
    take_fronts,
)
from factorbus.solver.kernels.inc_l.dense_update import MOST_BLOCKS, dense_omega_update
from factorbus.solver.kernels.inc_l.lambda_update import lambda_update
from factorbus.solver.kernels.inc_l.omega_update import MOST_ROWS, omega_update
from factorbus.solver.kernels.inc_l.records import BlockRows
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.sparse.blocks import HessianBlocks
from factorbus.solver.sparse.pivots import least_pivot
from factorbus.solver.sparse.symbolic import Symbolic

_NEW_NUMBERS = 6 * 12  # doubles a new row takes at most
_NEW_INDEX = 4


@dataclass(frozen=True, slots=True)
class Reach:
    """What new factors reach in R: the positions of the rows, ascending, and how many scalars those have.

    span: block columns from the leftmost affected one to the last, the loop size of the 2013 paper.
    """

    rows: I64
    scalars: int
    span: int


class BlockFactor(Arenas):
    """RᵀR = PΛPᵀ and d = R⁻ᵀPη."""

    ARENAS = BlockRows._fields
    NOT_KEPT = ("_room", "array_table")

    def __init__(self) -> None:
        self.rec: I64 = np.empty((16, br.RECORD), np.int64)
        self.index: I64 = np.empty(64, np.int64)
        self.numbers: F64 = np.empty(256)
        self.place: I64 = np.empty(16, np.int64)
        self.d: F64 = np.empty(64)
        self.counts: I64 = np.zeros(br.COUNTS, np.int64)
        self._mark: I64 = np.zeros(16, np.int64)
        self._found: I64 = np.empty(16, np.int64)
        self._room: F64 = np.empty(0)

    def take(self, symbolic: Symbolic, arena: F64, d: F64) -> None:
        """Copy R from the fronts of a multifrontal factorization, and d (in the order of `symbolic`)."""
        n = len(symbolic.order)
        self._reserve(n - int(self.counts[br.POSITIONS]), symbolic.size)
        if self.numbers.size < symbolic.stored:
            self.numbers = np.empty(symbolic.stored + symbolic.stored // 2)
        if self.index.size < symbolic.stored:
            self.index = np.empty(self.numbers.size, np.int64)
        take_fronts(
            symbolic.order, symbolic.dims, symbolic.starts, symbolic.fronts, symbolic.separator, arena, self.array_table
        )
        self.d[: symbolic.size] = d

    def append(self, graph: FactorGraph, v0: int) -> None:
        """Append rows without information for the free variables from index `v0` on."""
        v1 = int(graph.counts[at.VARIABLES])
        if v0 == v1:
            return
        self._reserve(v1 - v0, int(graph.counts[at.SCALARS]))
        self._make_room((v1 - v0) * _NEW_INDEX, (v1 - v0) * _NEW_NUMBERS)
        append_rows(v0, v1, graph.array_table, self.array_table)

    def reach(self, graph: FactorGraph, f0: int) -> Reach:
        """What the factors from id `f0` on reach; their variables have rows."""
        seen = np.zeros(1, np.int64)
        f1 = int(graph.counts[at.FACTORS])
        count = reach_rows(f0, f1, graph.array_table, self.array_table, self._mark, self._found, seen)
        rows = self._found[:count]
        return Reach(rows, int(seen[0]), int(self.counts[br.POSITIONS] - rows[0]) if count else 0)

    def omega_update(self, graph: FactorGraph, f0: int, reach: Reach) -> bool:
        """R₂₂ := chol(R₂₂ᵀR₂₂ + Ω) for the factors from id `f0` on, linearized at the graph's values; d with it.

        False: a pivot failed, and R is of no use any more.
        """
        f1 = int(graph.counts[at.FACTORS])
        self._make_room_to_grow(reach)
        if reach.rows.size <= MOST_BLOCKS:
            return dense_omega_update(f0, f1, reach.rows, graph.array_table, self.array_table) < 0
        if self._room.size < MOST_ROWS * reach.scalars:
            self._room = np.empty(2 * MOST_ROWS * reach.scalars)
        return omega_update(f0, f1, graph.array_table, self.array_table, reach.scalars, self._room) < 0

    def lambda_update(self, blocks: HessianBlocks, reach: Reach) -> bool:
        """R₂₂ := chol(Λ₂₂ − R₁₂ᵀR₁₂); d with it.  False: a pivot failed, and R is of no use any more."""
        self._make_room_to_grow(reach)
        count = int(blocks.fill[0])
        return lambda_update(reach.rows, count, blocks.pattern, blocks.data, blocks.eta, self.array_table) < 0

    def forward(self, eta: F64, d: F64) -> float:
        """d = R⁻ᵀPη in elimination order, from η in insertion order; gives dᵀd."""
        return float(solve_block_rows_transposed(self.array_table, eta, d))

    def back(self, d: F64) -> F64:
        """δ = PᵀR⁻¹d, in insertion order."""
        x, delta = np.empty(d.size), np.empty(d.size)
        solve_block_rows(self.array_table, d, x, delta)
        return delta

    def memory_bytes(self) -> int:
        """Bytes in use of all arenas."""
        positions, index, numbers = (int(self.counts[entry]) for entry in (br.POSITIONS, br.INDEX, br.NUMBERS))
        return 8 * (positions * (br.RECORD + 1) + index + numbers + self.d.size)

    def least_pivot(self) -> float:
        """The least R_kk²; infinite without any."""
        rec = self.rec[: self.counts[br.POSITIONS]]
        return least_pivot(self.numbers, rec[:, br.ROW], rec[:, br.DIM], rec[:, br.LD])

    def nonzeros(self) -> int:
        """Doubles of R on and above the diagonal, the zeros of joined fronts among them."""
        rec = self.rec[: self.counts[br.POSITIONS]]
        return int((rec[:, br.DIM] * rec[:, br.WIDTH] - rec[:, br.DIM] * (rec[:, br.DIM] - 1) // 2).sum())

    def _reserve(self, more: int, scalars: int) -> None:
        """Room for `more` positions, `scalars` in all."""
        need = int(self.counts[br.POSITIONS]) + more
        if need > len(self.rec):
            self.rec, self.place, self._mark = (with_room(a, need) for a in (self.rec, self.place, self._mark))
            self._found = np.empty(len(self.rec), np.int64)
        if scalars > self.d.size:
            self.d = with_room(self.d, scalars)

    def _make_room_to_grow(self, reach: Reach) -> None:
        """Room for every reached row to be joined with all reached ones behind it, half as much again to grow."""
        rows = reach.rows.size
        self._make_room(rows * (rows + 4) * 3 // 2, reach.scalars * (reach.scalars * 3 // 2 + 24))

    def _make_room(self, positions: int, numbers: int) -> None:
        """Free room at the end of the arenas; rows that moved left gaps, which are closed where that is enough."""
        index_need, need = int(self.counts[br.INDEX]) + positions, int(self.counts[br.NUMBERS]) + numbers
        if index_need <= self.index.size and need <= self.numbers.size:
            return
        rec = self.rec[: self.counts[br.POSITIONS]]
        live, listed = int((rec[:, br.DIM] * rec[:, br.LD]).sum()), int(rec[:, br.ROOM].sum())
        index = np.empty(max(self.index.size, 2 * (listed + positions)), np.int64)
        fresh = np.empty(max(self.numbers.size, 2 * (live + numbers)))
        compact_rows(self.array_table, index, fresh)
        self.index, self.numbers = index, fresh
