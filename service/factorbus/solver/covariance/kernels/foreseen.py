"""Loop closures in the plane judged before the step of their batch, in one call: their ends, the joint covariance of
what these follow from, and what the map expects.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, kernel
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.kernels.closures.ahead import MOVED, believe_ahead, judge_ahead, list_closure_ends
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import graph_at


@kernel(
    "int64(int64[::1], int64[::1], int64[::1], int64[::1], int64[::1], float64[::1], int64[:,::1], float64[:,:,::1])"
)
def foresee_closures(
    before: I64, closing: I64, graph_table: I64, tree_table: I64, sizes: I64, limits: F64, ends: I64, out: F64
) -> int:
    """Arguments as of `list_closure_ends`, `judge_ahead` and `believe_ahead`; gives how many are believed.

    before: what was in use after the last step, as `counts` of a graph.  sizes: the dimension of each kind of variable.
    Below 0: it is not by odometry alone, and nothing is judged.
    """
    v0, f0 = before[at.VARIABLES], before[at.FACTORS]
    free, moved = np.empty(2 * closing.size, np.int64), np.empty((2 * closing.size, MOVED))
    count = list_closure_ends(v0, f0, closing, graph_table, free, ends, moved)
    if count < 0:
        return -1
    known = np.empty((3 * count, 3 * count))
    joint_block(free[:count], graph_at(graph_table).var, sizes, tree_table, known)
    judge_ahead(closing, graph_table, ends, moved, known, out)
    return believe_ahead(limits, out)
