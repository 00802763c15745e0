"""Loop closures in the plane that the map has, held against the map without them, in one call: the worst by their
bounds, the joint covariance of their ends, and new bounds of these.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, inline_kernel, kernel
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.kernels.closures.ahead import residual_weighed
from factorbus.solver.kernels.closures.back import Bools, bound_without, list_free_ends, list_worst
from factorbus.solver.kernels.model.records import graph_at

WORST = 4  # of them the covariance is computed at one look


@kernel(
    "int64(boolean[::1], UniTuple(int64, 3), int64[:,::1], UniTuple(float64[:,:,::1], 3), int64[::1], int64[::1],"
    " int64[::1], float64)"
)
def find_contradicted(
    is_tested: Bools,
    looked_at: tuple[int, int, int],
    ends: I64,
    columns: tuple[F64, F64, F64],
    graph_table: I64,
    tree_table: I64,
    sizes: I64,
    most: float,
) -> int:
    """The row with the largest d² against the map without it, of the few with the largest bounds; −1: none is beyond
    `most`.

    in      is_tested: of the rows of a ledger, which are looked at  looked_at: how many rows there are; how many of the
            tested ones are looked at, and which look this is: where there are more, others at the next one
            ends: of all its closures  sizes: the dimension of each kind of variable
    in/out  columns: what was measured, Ω⁻¹ and bounds of all its closures; bounds of the worst are made anew
    """
    z, noise, bound = columns
    graph = graph_at(graph_table)
    rows = rows_looked_at(is_tested, looked_at)
    found, distance = np.empty(WORST, np.int64), np.empty(WORST)
    count = list_worst(rows, ends, z, bound, graph_table, most, found, distance)
    if count == 0:
        return -1
    free, places = np.empty(2 * count, np.int64), np.empty((count, 2), np.int64)
    different = list_free_ends(found[:count], ends, graph_table, free, places)
    known = np.empty((3 * different, 3 * different))
    joint_block(free[:different], graph.var, sizes, tree_table, known)
    bound_without(found[:count], ends, noise, places, known, graph_table, bound)
    worst, largest = -1, most
    for k in range(count):
        d2 = residual_weighed(found[k], ends, z, bound, graph.var, graph.values)
        if d2 > largest:
            worst, largest = found[k], d2
    return worst


@inline_kernel
def rows_looked_at(is_tested: Bools, looked_at: tuple[int, int, int]) -> I64:
    """Those of the tested ones whose turn it is."""
    count, most, look = looked_at
    tested, size = np.empty(count, np.int64), 0
    for row in range(count):
        if is_tested[row]:
            tested[size] = row
            size += 1
    if size <= most:
        return tested[:size]
    rows = np.empty(most, np.int64)
    for k in range(most):
        rows[k] = tested[(look * most + k) % size]
    return rows
