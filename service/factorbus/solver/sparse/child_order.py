"""The order of the subtrees of an elimination tree by which the fewest update matrices wait at a time.  MATH §5.

An update matrix waits from when its front is made until that of its parent is.  Fill-in and operations are the same in
any postorder, but the memory is not: where points come first, each as a front of its own, all of them would wait while
the cameras below are eliminated.
"""

import numpy as np

from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.sparse.symbolic import Symbolic, analyze

# Where update matrices take more than this number of times as much as R another order of subtrees is looked for.
_MUCH = 2.0


def with_few_waiting(symbolic: Symbolic, rows: I64, cols: I64) -> Symbolic:
    """The same order but for that of subtrees, or `symbolic` itself where that does not save memory.

    rows, cols (nb,): the blocks of Λ that were analysed.
    """
    if symbolic.arena <= (1.0 + _MUCH) * symbolic.stored:
        return symbolic
    first, fronts = symbolic.fronts[:, fr.VARIABLE], _postorder(symbolic.fronts)
    count = np.diff(first, append=symbolic.order.size)[fronts]
    first, put = first[fronts], np.cumsum(count) - count
    perm = symbolic.order[np.repeat(first - put, count) + np.arange(symbolic.order.size)]
    other = analyze(symbolic.dims, rows, cols, perm)
    return other if other.arena < symbolic.arena else symbolic


def _postorder(fronts: I64) -> I64:
    """Fronts, children before parents: of each the child first whose subtree needs the most beside what it leaves, as
    Liu's rule for the least peak of a stack has it.  So those without children, most of all, come last."""
    count, parents, separator = len(fronts), fronts[:, fr.PARENT], fronts[:, fr.SEPARATOR].astype(float)
    left, leaf = 0.5 * separator * separator, (fronts[:, fr.CHILD] < 0) & (parents >= 0)
    waiting = np.bincount(parents[leaf], left[leaf], count).tolist()
    inner = _inner_postorder(np.flatnonzero(~leaf).tolist(), parents.tolist(), left.tolist(), waiting)
    place = np.empty(count, np.int64)
    place[inner] = 2 * np.arange(len(inner)) + 1
    place[leaf] = place[parents[leaf]] - 1
    return np.argsort(place, kind="stable")


def _inner_postorder(inner: list[int], parents: list[int], left: list[float], leaves: list[float]) -> list[int]:
    """The fronts `inner` in that order.  left: what each leaves; leaves: what its children without children leave."""
    children: dict[int, list[int]] = {f: [] for f in inner}
    need = dict[int, float]()
    for f in inner:
        children[f].sort(key=lambda c: left[c] - need[c])
        waiting = most = 0.0
        for c in children[f]:
            most = max(most, waiting + need[c])
            waiting += left[c]
        need[f] = max(most, waiting + leaves[f] + left[f])
        if parents[f] >= 0:
            children[parents[f]].append(f)
    order, stack = list[int](), [f for f in inner if parents[f] < 0]
    while stack:  # parents first, from the last child on
        f = stack.pop()
        order.append(f)
        stack += children[f]
    return order[::-1]
