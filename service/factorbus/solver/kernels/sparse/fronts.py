"""What a front is: the record that the multifrontal kernels share, and how its numbers lie in the arena.

A front holds p pivot scalars and a separator of m scalars, in elimination order.  Its rows of R are p rows over p + m
columns, column j of row i at `ROWS + i·LD_ROWS + j`; its update matrix is m x m, upper triangle, column j of row i at
`UPDATE + update_row(i, WIDTH_UPDATE) + j`.  Both start their separator columns at a multiple of LANES doubles
and pad rows to one, so that whole vectors cover them and none lies across a cache line; what a row of R has before
its first column, and behind its last, belongs to nobody.

Of an update matrix GROUP rows at a time begin with the same column, the first that the diagonal of any is in, so the
rows of a group have a common stride and little is kept below the diagonal.
"""

from typing import NamedTuple

from factorbus.solver.kernels.jit.compile import I64, inline_kernel, vector_lanes

COLUMN = 0  # first pivot scalar, in elimination order
PIVOTS = 1  # p
SEPARATOR = 2  # m
ROWS = 3
LD_ROWS = 4
UPDATE = 5
WIDTH_UPDATE = 6  # of its first rows
PARENT = 7  # -1: a root
CHILD = 8  # first child, -1: none
SIBLING = 9  # next child of the same parent
RUNS = 10  # its runs are runs[RUNS : RUNS_END]
RUNS_END = 11
SEPARATOR_AT = 12  # its separator scalars, in elimination order, are separator[SEPARATOR_AT : SEPARATOR_AT + m]
BLOCKS = 13  # the blocks of Λ that it takes in are blocks[BLOCKS : BLOCKS_END]
BLOCKS_END = 14
VARIABLE = 15  # first pivot variable, in elimination order
FRONT = 16  # int64 in a record: 128 bytes

# A run: separator columns [first, first + count) of a child are columns [into, into + count) of its parent; a run lies
# wholly among the parent's pivots or wholly in its separator.
RUN = 3
RUN_FIRST, RUN_COUNT, RUN_INTO = range(RUN)

# A block: its number, where it goes, rows and columns there, and whether to turn it.
BLOCK = 5
BLOCK_NUMBER, BLOCK_AT, BLOCK_ROWS, BLOCK_COLUMNS, BLOCK_TURN = range(BLOCK)
STRAIGHT, TURNED, DIAGONAL = 0, 1, 2

# The first doubles of an arena: room for a 4 x 4 triangle, for each thread that may be at it.
MOST_WORKERS = 7  # threads besides the one whose arena it is
SCRATCH_OF_ONE = 16
SCRATCH = SCRATCH_OF_ONE * (1 + MOST_WORKERS)

LANES = vector_lanes()
GROUP = 8  # a multiple of LANES, and of the rows that `dense` makes at a time


class Front(NamedTuple):
    """Where a front is in its arena: its `pivots` rows of R begin at `rows`, `ld` apart, over `pivots` + `separator`
    columns; its update matrix begins at `update`, the first rows `width` wide."""

    rows: int
    ld: int
    pivots: int
    separator: int
    update: int
    width: int


@inline_kernel
def front_of(record: I64) -> Front:
    """The front of a record."""
    return Front(record[ROWS], record[LD_ROWS], record[PIVOTS], record[SEPARATOR], record[UPDATE], record[WIDTH_UPDATE])


@inline_kernel
def padded_size(count: int) -> int:
    """The next multiple of LANES."""
    return (count + LANES - 1) & ~(LANES - 1)


@inline_kernel
def row_stride(count: int) -> int:
    """Padded, and not a multiple of a large power of two, whose rows would share a few sets of the cache."""
    stride = padded_size(count)
    return stride + 8 if stride >= 128 and stride % 16 == 0 else stride


@inline_kernel
def update_row(i: int, width: int) -> int:
    """Where column 0 of row i of an update matrix would be, counted from its start."""
    first = i & ~(GROUP - 1)
    return first * width - first * (first - GROUP) // 2 + (i - first) * (width - first) - first


@inline_kernel
def update_stride(i: int, width: int) -> int:
    """From row i to the next one of its group."""
    return width - (i & ~(GROUP - 1))


@inline_kernel
def update_size(m: int, width: int) -> int:
    """Doubles of an update matrix of m rows."""
    return update_row(m - 1, width) + width if m > 0 else 0
