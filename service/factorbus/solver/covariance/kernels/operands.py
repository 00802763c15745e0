"""Where the operands of a product are in their arrays, in doubles: of what `tiles` computes, and who calls it."""

from typing import NamedTuple


class Tile(NamedTuple):
    """A few rows of whole vectors of LANES doubles: `rows` ≤ 4 of `vectors`, the first at `at`, `ld` apart."""

    rows: int
    vectors: int
    at: int
    ld: int


class Strided(NamedTuple):
    """A matrix by rows or by columns: entry (i, k) is at `at + i·row + k·column`."""

    at: int
    row: int
    column: int


class VectorRows(NamedTuple):
    """Rows of vectors, as many as the product needs: the first at `at`, `ld` apart."""

    at: int
    ld: int
