"""The analysis of a pattern: all that a factorization needs to know before it sees a number."""

from dataclasses import dataclass

import numpy as np

from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.sparse.fronts import SEPARATOR
from factorbus.solver.kernels.sparse.symbolic import analyze_pattern
from factorbus.solver.sparse.ordering import checked_pattern, integers


@dataclass(frozen=True, slots=True, eq=False)
class Symbolic:
    """Fronts of Λ in an elimination order; see `kernels/sparse/fronts.py` for the records.

    order (n,): the variable eliminated k-th (fill and constraints as in the given order, fronts in postorder).
    place (n,): first scalar of each variable in elimination order.  starts (n + 1,): in insertion order.
    nnz_r: structural scalar nonzeros of R.  flops: to factorize, the sum of squared row lengths of R.
    areas (nb,): numbers in each block.  widest: scalars of the longest separator.
    stored: doubles that hold R, with padding and the zeros of joined fronts.  arena: those and the update matrices.
    """

    dims: I64
    order: I64
    place: I64
    starts: I64
    fronts: I64
    runs: I64
    separator: I64
    blocks: I64
    areas: I64
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
    Raises ValueError when an index is outside its range, a diagonal block is missing, or perm is no permutation.
    """
    dims, rows, cols = checked_pattern(dims, rows, cols)
    perm, diagonal = integers(perm), np.zeros(len(dims), bool)
    diagonal[rows[rows == cols]] = True
    if not diagonal.all():
        raise ValueError(f"variable {int(diagonal.argmin())} has no diagonal block: each needs one")
    if not is_permutation(perm, len(dims)):
        raise ValueError(f"perm is not a permutation of 0 to {len(dims) - 1}")
    order, place, fronts, runs, separator, blocks, sizes, work = analyze_pattern(dims, rows, cols, perm)
    starts = np.zeros(len(dims) + 1, np.int64)
    np.cumsum(dims, out=starts[1:])
    stored, arena = (int(size) for size in sizes)
    return Symbolic(
        dims,
        order,
        place,
        starts,
        fronts,
        runs,
        separator,
        blocks,
        areas=dims[rows] * dims[cols],
        widest=int(fronts[:, SEPARATOR].max(initial=0)),
        stored=stored,
        arena=arena,
        nnz_r=int(work[0]),
        flops=float(work[1]),
    )


def is_permutation(perm: I64, n: int) -> bool:
    """Whether perm holds each of 0 .. n - 1 once."""
    if len(perm) != n or perm.min(initial=0) < 0 or perm.max(initial=-1) >= n:
        return False
    seen = np.zeros(n, bool)
    seen[perm] = True
    return bool(seen.all())
