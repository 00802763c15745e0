"""All diagonal blocks kept up from step to step, in the mode "bayes-tree".  MATH §10.6.

A step that moves no linearization point changes Λ by its new factors.  Of these, one for each new variable only says
where that is; the others, the loops, are a downdate of the old blocks of few ranks.  After any other step the recursion
is gone through for what was eliminated anew, and below that.  Both end where a change becomes negligible; so that this
and rounding errors do not add up, all blocks are computed anew after some steps.
"""

import numpy as np

from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.covariance.kernels.downdate import DONE, downdate_blocks, weighted_jacobians
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.covariance.kernels.recursion import diagonal_blocks, list_root_cliques
from factorbus.solver.covariance.square_root import DIMS, LARGEST
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import are_of_many
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.candidates import evaluate_factors

# The most numbers of loops in all for a downdate, and the most new variables; with more all is computed anew.
_MOST_RANKS, _MOST_NEW = 12, 8
# So that rounding and changes that were negligible do not add up, all blocks are computed anew after this many updates.
_REFRESH = 256
_RESIDUAL = np.zeros(1 + max(FACTOR_KIND_OF_CODE), np.int64)
for _code, _kind in FACTOR_KIND_OF_CODE.items():
    _RESIDUAL[_code] = _kind.dim
_SIZES = _RESIDUAL.tolist()


class Upkeep:
    """Diagonal blocks of a map, as of the last `update`.  For the thread that steps."""

    def __init__(self, graph: FactorGraph, tree: CliqueTree) -> None:
        self._graph, self._tree = graph, tree
        self._count, self._factors, self._step, self._age = 0, 0, -1, 0
        self._width = 1
        self._blocks: F64 = np.zeros((0, 1, 1))
        self._dims: I64 = np.empty(0, np.int64)
        self._scalar: I64 = np.empty(0, np.int64)
        self._changed_at: I64 = np.empty(0, np.int64)
        self._stamp = -1
        self.anew = 0  # updates that went through the recursion
        self.whole = 0  # of these, in the whole tree

    def diagonal(self) -> F64:
        """(n, d, d): the covariance of every variable, in the upper left corners, d of the largest there is; a view."""
        return self._blocks[: self._count]

    def update(self) -> None:
        """After a step, or several."""
        old, first_factor = self._count, self._factors
        state = self._tree.state
        step = int(state[tl.S_STEP])
        follows = step == self._step + 1 and self._age < _REFRESH
        self._extend()
        adds_only = not state[tl.S_RELINEARIZED] and state[tl.S_EDITED_AT] <= self._step
        loops = self._loops(old, first_factor) if follows and adds_only else None
        self._age = self._age + 1 if follows else 0
        if loops is None or not self._downdate(loops, old, first_factor, step):
            self._compute(self._stamp if follows else -1, step)
        self._step, self._stamp = step, int(state[tl.S_STAMP])

    def _extend(self) -> None:
        counts, old = self._graph.counts, self._count
        self._factors, self._count = int(counts[at.FACTORS]), int(counts[at.VARIABLES])
        if self._count == old:
            return
        new = self._graph.var[old : self._count]
        dims = DIMS[new[:, at.V_KIND]]
        width = max(self._width, int(dims.max()))
        if self._count > len(self._blocks) or width > self._width:
            self._enlarge(max(2 * self._count, len(self._blocks)), width)
        self._dims[old : self._count], self._scalar[old : self._count] = dims, new[:, at.V_SCALAR]

    def _enlarge(self, count: int, width: int) -> None:
        """Room for a number of variables and of their numbers."""
        blocks, dims, scalar = np.zeros((count, width, width)), np.zeros(count, np.int64), np.zeros(count, np.int64)
        kept, changed_at = len(self._blocks), np.full(count, -1)
        blocks[:kept, : self._width, : self._width] = self._blocks
        dims[:kept], scalar[:kept], changed_at[:kept] = self._dims, self._scalar, self._changed_at
        self._blocks, self._dims, self._scalar, self._changed_at = blocks, dims, scalar, changed_at
        self._width = width

    def _compute(self, since: int, step: int) -> None:
        """Blocks by the recursion, where the tree changed after the elimination `since` and where that changes them."""
        tree, count = self._tree, self._count
        roots = np.empty(count, np.int64)
        roots = roots[: list_root_cliques(tree.node[:count], tree.clique, roots)]
        dims, changed_at = self._dims[:count], self._changed_at[:count]
        diagonal_blocks(roots, tree.array_table, dims, since, step, changed_at, self._blocks[:count])
        self.anew += 1
        self.whole += since < 0

    def _loops(self, old: int, first: int) -> list[int] | None:
        """The new factors but one for each new variable, which places it; None: not all are placed so.

        Nor can there be a downdate by a factor of more than two variables, or a linear one.
        """
        if self._count - old > _MOST_NEW:
            return None
        free = {v for v in range(old, self._count) if self._scalar[v] >= 0}
        loops = []
        if are_of_many(self._graph.fac[first : self._factors]).any():
            return None
        for k, row in enumerate(self._graph.fac[first : self._factors].tolist()):
            ends = [v for v in (row[at.F_I], row[at.F_J]) if v in free]
            if not ends:
                loops.append(k)
            elif len(ends) == 1 and _SIZES[row[at.F_KIND]] >= self._dims[ends[0]]:
                free.discard(ends[0])
            else:
                return None
        return None if free else loops

    def _downdate(self, loops: list[int], old: int, first: int, step: int) -> bool:
        """Downdate the blocks of old variables by the loops, and compute those of new ones.  (10.10)"""
        tree, count = self._tree, self._count
        if loops and not self._downdate_old(np.array(loops), old, first, step):
            return False
        for v in range(old, count):
            if self._scalar[v] >= 0:
                d = int(self._dims[v])
                out = np.empty((d, d))
                joint_block(np.array([v]), self._graph.var, DIMS, tree.array_table, out)
                self._blocks[v, :d, :d] = out
        return True

    def _downdate_old(self, loops: I64, old: int, first: int, step: int) -> bool:
        """The blocks of old variables; False: too many ranks, or too few digits would be left."""
        graph, tree, count = self._graph, self._tree, self._count
        fac = graph.fac[first : self._factors]
        sizes = _RESIDUAL[fac[:, at.F_KIND]]
        if sizes[loops].sum() > _MOST_RANKS:
            return False
        n = len(fac)
        r, A, B, W = np.zeros((n, at.R_SIZE)), *(np.zeros((n, LARGEST, LARGEST)) for _ in range(3))
        evaluate_factors(np.arange(first, self._factors), graph.array_table, tree.lin[0], r, A, B, W)
        dims, scalar, changed_at = self._dims[:count], self._scalar[:count], self._changed_at[:count]
        ends = fac[loops, at.F_I : at.F_J + 1]
        ends = np.where((ends >= 0) & (scalar[ends] >= 0), ends, -1)
        H = np.zeros((ends.size, LARGEST, int(sizes[loops].sum())))
        weighted_jacobians(ends, sizes[loops], A[loops], B[loops], W[loops], H)
        found = downdate_blocks(
            ends.reshape(-1), H, tree.array_table, dims, scalar, step, changed_at, self._blocks[:old]
        )  # fmt: skip
        return found == DONE
