"""The largest set of which each is consistent with each other one: a maximum clique.

Branch and bound over sets of bits.  A set that is coloured with k colours, no two consistent ones in the same colour's
complement, has no clique of more than k (Tomita and Seki 2003, MCQ).  The search ends after `MOST_BRANCHES` branches
with the largest that it has found: of consistent sets that are large and lack a few pairs, an exact search may take for
ever, and the first clique that it comes to is close to the largest.
"""

from collections.abc import Sequence

import numpy as np

MOST_BRANCHES = 50_000


def largest_clique(consistent: np.ndarray) -> list[int]:
    """The members, ascending, of a largest clique of a graph.

    consistent (n, n) bool: symmetric; the diagonal is not looked at.  Of several equal ones the same at every call.
    """
    count = len(consistent)
    order = sorted(range(count), key=lambda v: (-int(consistent[v].sum()), v))  # many neighbours first
    place = {v: k for k, v in enumerate(order)}
    near = [sum(1 << place[u] for u in np.flatnonzero(consistent[v]).tolist() if u != v) for v in order]
    return sorted(order[k] for k in _Search(near).run())


class _Search:
    """near[k]: the neighbours of node k, as bits."""

    def __init__(self, near: Sequence[int]) -> None:
        self._near, self._best, self._branches = near, list[int](), 0

    def run(self) -> list[int]:
        """Depth first, on a stack of (what may still join, in the order of their colours; members)."""
        stack = [(*self._coloured((1 << len(self._near)) - 1), list[int]())]
        while stack and self._branches < MOST_BRANCHES:
            nodes, colours, members = stack[-1]
            if not nodes or len(members) + colours[-1] <= len(self._best):
                stack.pop()
                continue
            node = nodes.pop()
            colours.pop()
            self._branches += 1
            left = sum(1 << k for k in nodes) & self._near[node]
            if left:
                stack.append((*self._coloured(left), [*members, node]))
            elif len(members) + 1 > len(self._best):
                self._best = [*members, node]
        return self._best

    def _coloured(self, left: int) -> tuple[list[int], list[int]]:
        """The nodes of `left` by rising colour, and the colour of each: no clique in the first k has more than the
        k-th colour."""
        nodes, colours, colour = list[int](), list[int](), 0
        while left:
            colour += 1
            free = left
            while free:
                node = (free & -free).bit_length() - 1
                left &= ~(1 << node)
                free &= ~(1 << node) & ~self._near[node]
                nodes.append(node)
                colours.append(colour)
        return nodes, colours
