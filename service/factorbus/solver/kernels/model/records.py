"""The factor graph as kernels see it: its arrays by name."""

from typing import Annotated, NamedTuple

from factorbus.solver.kernels.jit.records import Floats, IntRows, Ints, RowWidth, opener
from factorbus.solver.kernels.model import layout as at


class Graph(NamedTuple):
    """The arrays of a graph; `layout` has the columns of `var` and `fac` and the entries of `counts`.

    var      (n, 5) int64    one row per variable, in insertion order
    fac      (m, 8) int64    rows of factors, in insertion order: one of a factor of one or two variables, of more
                             variables one for each pair (`factor_rows`)
    values   float64         the variables' values, packed one after the other
    payload  float64         per factor: measurement, upper triangle of its information, scale of its loss if any
    counts   (8,)   int64    how much of each array is in use
    keys     (n,)   int64    the variables' keys
    table    int64           where a key is found (`graph.key_table`)
    dims     (c,)   int64    scalars of each block column of Λ
    stamps   (n,)   int64    the variables' time stamps, which the solver carries and never looks into; NO_STAMP: none
    """

    var: Annotated[IntRows, RowWidth(at.V_WIDTH)]
    fac: Annotated[IntRows, RowWidth(at.F_WIDTH)]
    values: Floats
    payload: Floats
    counts: Ints
    keys: Ints
    table: Ints
    dims: Ints
    stamps: Ints


class Ends(NamedTuple):
    """Where the values of a factor's variables begin; j means nothing where it has one variable."""

    i: int
    j: int


graph_at = opener(Graph)
