"""Blocks of the covariance of a map: of one variable, of several together, between two.  MATH §10.1, §10.2.

A block is in the tangent spaces of its variables: local increments, translation first
(`factorbus.solver.graph.variables`).
Fixed variables have covariance zero.
"""

import numpy as np

from factorbus.solver.covariance.kernels.columns import cross_blocks
from factorbus.solver.covariance.kernels.paths import joint_block
from factorbus.solver.covariance.kernels.whole import whole_blocks
from factorbus.solver.covariance.square_root import DIMS, SquareRoot
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64

# For fewer variables than this share of all, going up from each is sooner done than the recursion from the roots.
_FEW = 1 / 64
_FEW_PAIRS = 4
# The joint covariance of d scalars takes d² for each row of R that it goes through, columns of Σ for e of them some
# _COLUMN times e for each number of R: measured on maps of 3,000 and 10,000 poses.
_COLUMN = 10


class CovarianceBlocks:
    """Covariances of one factored map, computed when they are asked for.  For one thread at a time.

    width: d of the largest variable there is; blocks of smaller ones are in the upper left corners.
    """

    def __init__(self, factored: SquareRoot) -> None:
        self.factored = factored
        self.width = int(factored.dims.max(initial=1))
        self._diagonal: F64 | None = None
        self._hub, self._column = -1, np.zeros((0, self.width, self.width))

    def diagonal(self, hub: int = -1) -> F64:
        """(n, width, width): of every variable, in the upper left corners.

        When they are computed, so is on the way what `pairs` will be asked for of variable `hub`, unless that is −1.
        """
        if self._diagonal is None:
            f = self.factored
            hub = hub if hub >= 0 and f.scalar[hub] >= 0 else -1
            diagonal = np.zeros((f.count, self.width, self.width))
            column = np.zeros_like(diagonal) if hub >= 0 else self._column
            whole_blocks(f.order, hub, f.tree.array_table, f.dims, f.scalar, diagonal, column)
            self._diagonal, self._hub, self._column = diagonal, hub, column
        return self._diagonal

    def of(self, variables: I64) -> F64:
        """(k, width, width): of some variables, each by itself."""
        if self.prefers_all(variables.size):
            return self.diagonal()[variables]
        out = np.zeros((variables.size, self.width, self.width))
        for k, v in enumerate(variables.tolist()):
            d = int(self.factored.dims[v])
            out[k, :d, :d] = self._by_paths(variables[k : k + 1], variables[k : k + 1])
        return out

    def prefers_all(self, count: int) -> bool:
        """Whether this number of variables is sooner looked up among all than computed by itself."""
        whole = self.factored.order.size > 0
        return self._diagonal is not None or (whole and count > _FEW * self.factored.count)

    def joint(self, variables: I64) -> F64:
        """(d, d): of several variables together, in their order; a variable may come twice."""
        return self.between(variables, variables)

    def path_scalars(self, variables: I64) -> int:
        """Rows of R between `variables` and the roots: what `joint` of them goes through."""
        f, seen, rows = self.factored, set[int](), 0
        clique = f.tree.clique
        for v in variables[f.scalar[variables] >= 0].tolist():
            c = int(f.tree.node[v, tl.N_CLIQUE])
            while c >= 0 and c not in seen:
                seen.add(c)
                rows += int(clique[c, tl.C_PIVOTS])
                c = int(clique[c, tl.C_PARENT])
        return rows

    def between(self, rows: I64, columns: I64) -> F64:
        """(d, e): between variables and variables, each in their order; one may come twice."""
        if self.prefers_columns(rows, columns):
            if np.array_equal(rows, columns):
                found = self._by_columns(rows, columns)
                return 0.5 * (found + found.T)
            if rows.size <= columns.size:
                return self._by_columns(rows, columns)
            return np.ascontiguousarray(self._by_columns(columns, rows).T)
        return self._by_paths(rows, columns)

    def _by_paths(self, rows: I64, columns: I64) -> F64:
        """The same, cut out of the joint covariance of all of them.  MATH (10.3)"""
        f = self.factored
        different = np.unique(np.concatenate([rows, columns]))
        free = different[f.scalar[different] >= 0]
        inner = np.zeros((int(f.dims[free].sum()),) * 2)
        joint_block(free, f.graph.var, DIMS, f.tree.array_table, inner)
        # Where the scalars of `variables` are in `inner`; the last row and column of zeros serve the fixed ones.
        starts = np.full(different.size, -1)
        starts[f.scalar[different] >= 0] = np.cumsum(f.dims[free]) - f.dims[free]
        padded = np.zeros((len(inner) + 1,) * 2)
        padded[:-1, :-1] = inner
        down, right = (_scalars(starts[np.searchsorted(different, ends)], f.dims[ends]) for ends in (rows, columns))
        return padded[np.ix_(down, right)]

    def prefers_columns(self, rows: I64, columns: I64) -> bool:
        """Whether what is between them is sooner made from a column of Σ for each of the fewer.  MATH (10.4)"""
        f = self.factored
        if not f.order.size:
            return False
        every, fewer = np.unique(np.concatenate([rows, columns])), min(rows, columns, key=len)
        scalars, wide = int(f.dims[every].sum()), int(f.dims[fewer].sum())
        return 0 < _COLUMN * f.tree.numbers.size * wide < scalars**2 * int(f.dims.sum())

    def _by_columns(self, few: I64, many: I64) -> F64:
        """(d, e): of one of the few after the other."""
        dims, out = self.factored.dims, []
        rows = np.repeat(np.arange(many.size), dims[many])
        within = np.arange(rows.size) - np.repeat(np.cumsum(dims[many]) - dims[many], dims[many])
        for v in few.tolist():
            blocks = self.pairs(np.full(many.size, v), many)
            out.append(blocks[rows, : dims[v], within].T)
        return np.ascontiguousarray(np.concatenate(out))

    def pairs(self, first: I64, second: I64) -> F64:
        """(k, width, width): between first[k] (rows) and second[k] (columns), each in the upper left corner."""
        f = self.factored
        if self._hub >= 0 and first.size:
            if (first == self._hub).all():
                return self._column[second]
            if (second == self._hub).all():
                return np.ascontiguousarray(self._column[first].transpose(0, 2, 1))
        if first.size <= _FEW_PAIRS or f.order.size == 0:
            return self._single_pairs(first, second)
        free_first, free_second = (np.where(f.scalar[ends] >= 0, ends, -1) for ends in (first, second))
        turned = _changes(free_second) < _changes(free_first)
        hubs, partners = (free_second, free_first) if turned else (free_first, free_second)
        order = np.argsort(hubs, kind="stable") if _changes(hubs) else np.arange(hubs.size)
        blocks = np.zeros((first.size, self.width, self.width))
        by_hub = blocks.transpose(0, 2, 1) if turned else blocks
        cross_blocks(hubs[order], partners[order], order, f.tree.array_table, f.order, f.dims, f.scalar, by_hub)
        return blocks

    def _single_pairs(self, first: I64, second: I64) -> F64:
        """The same, each from the paths of its two ends."""
        out = np.zeros((first.size, self.width, self.width))
        for k, (i, j) in enumerate(zip(first.tolist(), second.tolist(), strict=True)):
            d, e = int(self.factored.dims[i]), int(self.factored.dims[j])
            both = np.array([i, j])
            out[k, :d, :e] = self._by_paths(both, both)[:d, d:]
        return out


def _scalars(starts: I64, dims: I64) -> I64:
    """All scalars of variables whose first ones are at `starts`; −1 where that is."""
    first = np.repeat(starts, dims)
    within = np.arange(first.size) - np.repeat(np.cumsum(dims) - dims, dims)
    return np.where(first < 0, -1, first + within)


def _changes(ends: I64) -> int:
    """How often another end follows: about how many different ones there are."""
    return int(np.count_nonzero(ends[1:] != ends[:-1]))
