"""Loop closures in the plane judged before the step of their batch, in one call: their ends, the joint covariance of
what these follow from, and what the map expects.
"""

import numpy as np

from factorbus.solver.covariance.kernels.compile import F64, I64, kernel
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.kernels.closures.ahead import MOVED, judge_ahead, list_closure_ends
from factorbus.solver.kernels.model.records import graph_at


@kernel("int64(int64, int64, int64[::1], int64[::1], int64[::1], int64[::1], int64[:,::1], float64[:,:,::1])")
def foresee_closures(
    v0: int, f0: int, closing: I64, graph_table: I64, tree_table: I64, sizes: I64, ends: I64, out: F64
) -> int:
    """Arguments and result as of `list_closure_ends` and `judge_ahead`; sizes: the dimension of each kind of variable.

    Below 0: it is not by odometry alone, and nothing is judged.
    """
    free, moved = np.empty(2 * closing.size, np.int64), np.empty((2 * closing.size, MOVED))
    count = list_closure_ends(v0, f0, closing, graph_table, free, ends, moved)
    if count >= 0:
        known = np.empty((3 * count, 3 * count))
        joint_block(free[:count], graph_at(graph_table).var, sizes, tree_table, known)
        judge_ahead(closing, graph_table, ends, moved, known, out)
    return count
