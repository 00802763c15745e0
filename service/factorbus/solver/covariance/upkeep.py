"""All diagonal blocks kept up from step to step, in the mode "tree".  MATH §10.6.

A step that moves no linearisation point changes Λ by its new factors.  Of these, one for each new variable only says
where that is; the others, the loops, take from every old block what they tell of it, which is of few ranks.  After
any other step all blocks are computed anew, and after some hundred in any case, so that rounding errors do not add up.
"""

import numpy as np

from factorbus.solver.covariance.factored import DIMS, LARGEST, dims_of
from factorbus.solver.covariance.kernels.columns import cross_blocks
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.covariance.kernels.recursion import diagonal_blocks, list_cliques
from factorbus.solver.factors import FACTOR_KIND_OF_CODE
from factorbus.solver.graph import Graph
from factorbus.solver.joints import negative_rows
from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels._jit import F64, I64
from factorbus.solver.kernels.candidates import evaluate_factors
from factorbus.solver.tree import Tree

# Loops of so many numbers in all, and so many new variables, are worked in; with more all is computed anew.
_MOST_RANKS, _MOST_NEW = 12, 8
# The smallest share that other factors may have in what a loop measures: of what is subtracted, that many times the
# rounding error is lost.
_LEAST_SHARE = 1e-6
_REFRESH = 256
_RESIDUAL = np.zeros(1 + max(FACTOR_KIND_OF_CODE), np.int64)
for _code, _kind in FACTOR_KIND_OF_CODE.items():
    _RESIDUAL[_code] = _kind.dim


class Upkeep:
    """Diagonal blocks of a map, as of the last `update`.  For the thread that steps."""

    def __init__(self, graph: Graph, tree: Tree) -> None:
        self._graph, self._tree = graph, tree
        self._dims: I64 = np.empty(0, np.int64)
        self._scalar: I64 = np.empty(0, np.int64)
        self._blocks: F64 = np.zeros((16, LARGEST, LARGEST))
        self._factors, self._step, self._age = 0, -1, 0
        self.anew = 0  # updates that computed all blocks anew

    def diagonal(self) -> F64:
        """(n, 6, 6): the covariance of every variable, in the upper left corners; a view."""
        return self._blocks[: self._dims.size]

    def update(self) -> None:
        """After a step, or several."""
        old, first_factor = self._dims.size, self._factors
        follows = int(self._tree.state[tl.S_STEP]) == self._step + 1 and self._age < _REFRESH
        self._take_in()
        loops = self._loops(old, first_factor) if follows and not self._tree.state[tl.S_RELINEARISED] else None
        if loops is None or not self._work_in(loops, old):
            self._compute_anew()
        else:
            self._age += 1
        self._step = int(self._tree.state[tl.S_STEP])

    def _take_in(self) -> None:
        counts, old = self._graph.counts.tolist(), self._dims.size
        new = self._graph.var[old : counts[at.VARIABLES]]
        self._dims = np.append(self._dims, dims_of(new))
        self._scalar = np.append(self._scalar, new[:, at.V_SCALAR])
        self._factors = counts[at.FACTORS]
        if len(self._blocks) < self._dims.size:
            larger = np.zeros((2 * self._dims.size, LARGEST, LARGEST))
            larger[:old] = self._blocks[:old]
            self._blocks = larger
        self._blocks[old : self._dims.size] = 0.0

    def _compute_anew(self) -> None:
        tree, count = self._tree, self._dims.size
        diagonal_blocks(self._order(), tree.clique, tree.lists, tree.numbers, self._dims, self._blocks[:count])
        self._age = 0
        self.anew += 1

    def _order(self) -> I64:
        tree = self._tree
        order = np.empty(int(tree.state[tl.S_ALIVE]), np.int64)
        return order[: list_cliques(tree.node[: self._dims.size], tree.clique, order)]

    def _loops(self, old: int, first: int) -> I64 | None:
        """The new factors but one for each new variable, which places it; None: not all are placed so.

        Nor can those of negative weight be worked in one by one.
        """
        if negative_rows(self._graph, first).size:
            return None
        free = {v for v in range(old, self._dims.size) if self._scalar[v] >= 0}
        if len(free) > _MOST_NEW:
            return None
        loops = []
        for f in range(first, self._factors):
            ends = [int(v) for v in self._graph.fac[f, at.F_I : at.F_J + 1] if v in free]
            if not ends:
                loops.append(f)
            elif len(ends) == 1 and _numbers(self._graph, f) >= self._dims[ends[0]]:
                free.discard(ends[0])
            else:
                return None
        return None if free else np.array(loops, np.int64)

    def _work_in(self, loops: I64, old: int) -> bool:
        """Take what the loops tell from the blocks of old variables, and compute those of new ones.  (10.10)"""
        if loops.size:
            change = self._change(loops, old)
            if change is None:
                return False
            width = change.shape[1]
            self._blocks[:old, :width, :width] -= change
        for v in range(old, self._dims.size):
            if self._scalar[v] >= 0:
                d = int(self._dims[v])
                self._blocks[v, :d, :d] = self._joint(np.array([v]))
        return True

    def _change(self, loops: I64, old: int) -> F64 | None:
        """V M Vᵀ of (10.10) for all old variables; None: too many ranks, or too few digits would be left."""
        sizes = np.array([_numbers(self._graph, int(f)) for f in loops])
        if sizes.sum() > _MOST_RANKS:
            return None
        ends, H, L = self._stacked(loops, sizes)
        if not ends.size:
            return np.zeros((old, 1, 1))
        G = np.eye(len(L)) - L.T @ H @ self._joint(ends) @ H.T @ L
        if np.linalg.eigvalsh(G)[0] < _LEAST_SHARE:
            return None
        # V M Vᵀ = Z Zᵀ,  Z = Σ Hᵀ L C⁻ᵀ,  G = C Cᵀ.
        right = np.linalg.solve(np.linalg.cholesky(G), L.T @ H)
        tree, width = self._tree, int(self._dims.max())
        hubs, partners = np.repeat(ends, old), np.tile(np.arange(old), ends.size)
        partners[self._scalar[partners] < 0] = -1
        cross = np.zeros((hubs.size, width, width))
        cross_blocks(
            hubs, partners, np.arange(hubs.size), self._order(), self._scalar, tree.node, tree.clique, tree.lists,
            tree.numbers, self._dims, False, cross,
        )  # fmt: skip
        Z, start = np.zeros((old, len(L), width)), 0
        for k, v in enumerate(ends.tolist()):
            d = int(self._dims[v])
            Z += right[:, start : start + d] @ cross[k * old : (k + 1) * old, :d]
            start += d
        return Z.transpose(0, 2, 1) @ Z

    def _stacked(self, loops: I64, sizes: I64) -> tuple[I64, F64, F64]:
        """(free ends, H, L with Ω = L Lᵀ) of the loops together, linearised where R is."""
        graph = self._graph
        fac = graph.fac[loops]
        ends = np.unique(fac[:, at.F_I : at.F_J + 1])
        ends = ends[ends >= 0]
        ends = ends[self._scalar[ends] >= 0]
        starts = dict(zip(ends.tolist(), (np.cumsum(self._dims[ends]) - self._dims[ends]).tolist(), strict=True))
        H, L = np.zeros((int(sizes.sum()), int(self._dims[ends].sum()))), np.zeros((int(sizes.sum()),) * 2)
        r, A, B, W = np.zeros((1, 6)), *(np.zeros((1, 6, 6)) for _ in range(3))
        row = 0
        for f, size in zip(loops.tolist(), sizes.tolist(), strict=True):
            evaluate_factors(f, f + 1, graph.var, graph.fac, self._tree.lin[0], graph.payload, r, A, B, W)
            for v, J in ((int(graph.fac[f, at.F_I]), A[0]), (int(graph.fac[f, at.F_J]), B[0])):
                if v in starts:
                    d = int(self._dims[v])
                    H[row : row + size, starts[v] : starts[v] + d] = J[:size, :d]
            L[row : row + size, row : row + size] = np.linalg.cholesky(W[0, :size, :size])
            row += size
        return ends, H, L

    def _joint(self, variables: I64) -> F64:
        tree = self._tree
        out = np.empty((int(self._dims[variables].sum()),) * 2)
        joint_block(variables, self._graph.var, DIMS, tree.node, tree.clique, tree.lists, tree.numbers, out)
        return out


def _numbers(graph: Graph, factor: int) -> int:
    """Of the residual of a factor."""
    return int(_RESIDUAL[graph.fac[factor, at.F_KIND]])
