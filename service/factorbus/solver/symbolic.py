"""The analysis of a pattern: all that a factorisation needs to know before it sees a number."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver.kernels._jit import I64
from factorbus.solver.kernels.fronts import BORDER
from factorbus.solver.kernels.symbolic import analyze_pattern


@dataclass(frozen=True, slots=True, eq=False)
class Symbolic:
    """Fronts of Λ in an elimination order; see `kernels/fronts.py` for the records.

    order (n,): the variable eliminated k-th (fill and constraints as in the given order, fronts in postorder).
    place (n,): first scalar of each variable in elimination order.  starts (n + 1,): in insertion order.
    nnz_r: structural scalar nonzeros of R.  flops: to factorise, the sum of squared row lengths of R.
    widest: scalars of the longest border.
    stored: doubles that hold R, with padding and the zeros of joined fronts.  arena: those and the update matrices.
    """

    dims: I64
    order: I64
    place: I64
    starts: I64
    fronts: I64
    runs: I64
    border: I64
    blocks: I64
    widest: int
    stored: int
    arena: int
    nnz_r: int
    flops: float

    @property
    def size(self) -> int:
        """Scalars of the system."""
        return int(self.starts[-1])

    def scalar_order(self) -> I64:
        """The scalar (in insertion order) that is eliminated k-th."""
        first = np.repeat(self.starts[self.order], self.dims[self.order])
        within = np.arange(self.size) - np.repeat(self.place[self.order], self.dims[self.order])
        return first + within

    def variable_at(self, scalar: int) -> int:
        """The variable that the given scalar of the elimination order belongs to."""
        return int(self.order[np.searchsorted(self.place[self.order], scalar, side="right") - 1])


def analyze(dims: I64, rows: I64, cols: I64, perm: I64) -> Symbolic:
    """Analyse the pattern of Λ for elimination in the order `perm`.

    dims (n,).  rows, cols (nb,): its blocks, rows[b] <= cols[b], each pair once, the diagonal ones present.
    perm (n,): a permutation, as `order` gives it.
    """
    dims, rows, cols, perm = (np.ascontiguousarray(a, np.int64) for a in (dims, rows, cols, perm))
    order, place, fronts, runs, border, blocks, sizes, work = analyze_pattern(dims, rows, cols, perm)
    starts = np.zeros(len(dims) + 1, np.int64)
    np.cumsum(dims, out=starts[1:])
    widest = int(fronts[:, BORDER].max(initial=0))
    stored, arena = (int(size) for size in sizes)
    nnz_r, flops = int(work[0]), float(work[1])
    return Symbolic(dims, order, place, starts, fronts, runs, border, blocks, widest, stored, arena, nnz_r, flops)
