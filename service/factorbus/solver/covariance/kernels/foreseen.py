"""Loop closures in the plane judged before the step of their batch, in one call: their ends, the joint covariance of
what these follow from, and what the map expects.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, kernel
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.kernels.closures.ahead import (
    END_COLUMNS,
    MOVED,
    believe_ahead,
    enter_judged,
    judge_ahead,
    list_closure_ends,
)
from factorbus.solver.kernels.closures.back import Bools
from factorbus.solver.kernels.model.records import graph_at

S_VARIABLES, S_FACTORS, S_ENTERED, S_LOOK, S_CLOSING = range(5)  # of `staged`


@kernel(
    "int64(int64[::1], UniTuple(int64[::1], 4), float64[::1], UniTuple(float64[:,:,::1], 3), int64[:,::1],"
    " boolean[::1], float64[:,:,::1])"
)
def foresee_closures(
    staged: I64,
    tables: tuple[I64, I64, I64, I64],
    limits: F64,
    columns: tuple[F64, F64, F64],
    ends: I64,
    is_tested: Bools,
    out: F64,
) -> int:
    """What the map expects of closures that are staged; gives how many of them are believed.

    in   staged: how many variables and factors the last step had, how many closures the ledger has, which look this is,
         and the rows of the new ones among the factors, ascending
         tables: of the graph and of the tree; the dimension of each kind of variable; and when each closure of the
         ledger was looked at, which is written  limits: of `believe_ahead`
    out  out: of `judge_ahead`, with what `believe_ahead` writes
         columns, ends: of the ledger, with room behind: what was measured, Ω⁻¹, bounds and ends of the new ones; where
         all are believed also that they are looked at, and tested
    Below 0: it is not by odometry alone, and nothing is judged or written.
    """
    closing, entered = staged[S_CLOSING:], staged[S_ENTERED]
    graph_table, tree_table, sizes, looked = tables
    z, noise, bound = columns
    own = np.empty((2 * closing.size, END_COLUMNS), np.int64)
    free, moved = np.empty(2 * closing.size, np.int64), np.empty((2 * closing.size, MOVED))
    count = list_closure_ends(staged[S_VARIABLES], staged[S_FACTORS], closing, graph_table, free, own, moved)
    if count < 0:
        return -1
    known = np.empty((3 * count, 3 * count))
    joint_block(free[:count], graph_at(graph_table).var, sizes, tree_table, known)
    judge_ahead(closing, graph_table, own, moved, known, out)
    enter_judged(entered, out, own, z, noise, bound, ends)
    believed = believe_ahead(limits, out)
    if believed == closing.size:
        for n in range(entered, entered + believed):
            looked[n], is_tested[n] = staged[S_LOOK], True
    return believed
