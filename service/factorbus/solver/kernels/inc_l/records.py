"""R in block rows as kernels see it: arrays by name, and parts of a row."""

from typing import NamedTuple

from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.jit.records import Floats, IntRows, Ints, opener


class BlockRows(NamedTuple):
    """R and d; `block_rows` has the columns of `rec` and the entries of `counts`.

    rec      (n, 10) int64    one record per position
    index    int64            the lists of positions, each with room to grow
    numbers  float64          the rows: `DIM` scalar rows of `LD` doubles, the first `WIDTH` in use, block after block;
                              below the diagonal of the diagonal block they are zero
    place    (columns,) int64 position of each block column of Λ
    d        (scalars,) float64, in elimination order
    counts   (4,)    int64    how much of rec, scalars, index and numbers is in use
    """

    rec: IntRows
    index: Ints
    numbers: Floats
    place: Ints
    d: Floats
    counts: Ints


class BlockList(NamedTuple):
    """The blocks of a row: their positions are positions[first : first + count], and they have `width` scalars."""

    positions: I64
    first: int
    count: int
    width: int


rows_at = opener(BlockRows)
