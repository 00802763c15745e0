"""Λ and η in blocks, kept incrementally.  MATH §4.

Λ's pattern grows with variables and factors; its numbers are in one arena, each block row-major where the pattern says.
There are two copies of the numbers: the present ones, and a spare where a trial step is linearized, so that a step that
is not accepted costs nothing to undo.
"""

import numpy as np

from factorbus.solver.graph.arenas import table_size, with_room
from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.kernels.graph.block_pattern import connect_blocks, enter_blocks, remove_blocks
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import linearize


class HessianBlocks:
    """The normal equations Λ δ = η of a graph's free variables, linearized at given values."""

    NOT_KEPT = ("_spare_data", "_spare_eta")

    def __init__(self) -> None:
        self.pattern: I64 = np.empty((3, 32), np.int64)
        self.table: I64 = np.zeros(64, np.int64)
        self.fill: I64 = np.zeros(2, np.int64)  # blocks and numbers in use
        self.data: F64 = np.zeros(256)
        self.eta: F64 = np.zeros(64)
        self._spare_data: F64 = np.zeros(0)
        self._spare_eta: F64 = np.zeros(0)

    @property
    def rows(self) -> I64:
        """Block row of each block (a free variable in insertion order)."""
        return self.pattern[0, : self.fill[0]]

    @property
    def cols(self) -> I64:
        """Block column of each block, not before its row."""
        return self.pattern[1, : self.fill[0]]

    @property
    def offsets(self) -> I64:
        """Where each block starts in `data`."""
        return self.pattern[2, : self.fill[0]]

    def extend(self, graph: FactorGraph, since: Mark) -> float:
        """Add the variables and factors after `since`, linearized at the present values; gives the factors' χ²."""
        v0, v1 = since[at.VARIABLES], int(graph.counts[at.VARIABLES])
        f0, f1 = since[at.FACTORS], int(graph.counts[at.FACTORS])
        self._reserve(v1 - v0 + f1 - f0, int(graph.counts[at.SCALARS]))
        numbers = int(self.fill[1])
        connect_blocks(v0, v1, f0, f1, graph.array_table, self.table, self.pattern, self.fill)
        if (need := int(self.fill[1])) > self.data.size:
            self.data = with_room(self.data, need)
        self.data[numbers:need] = 0.0
        self.eta[since[at.SCALARS] : int(graph.counts[at.SCALARS])] = 0.0
        return float(linearize(f0, f1, graph.var, graph.fac, graph.values, graph.payload, self.data, self.eta))

    def unweighted(self, graph: FactorGraph, variables: I64) -> I64:
        """Those of the free `variables` that have a zero on the diagonal of Λ: no factor weighs that scalar there."""
        at_zero = np.zeros(len(variables), bool)
        rows = graph.var[variables]
        dims = graph.dims[rows[:, at.V_COLUMN]]
        for dim in np.unique(dims).tolist():
            at_zero[dims == dim] = (self.data[_diagonal(rows[dims == dim], dim)] == 0.0).any(1)
        return variables[at_zero]

    def diagonal(self, graph: FactorGraph) -> I64:
        """(scalars,), where in `data` the diagonal of Λ is."""
        out = np.empty(int(graph.counts[at.SCALARS]), np.int64)
        var = graph.var[: graph.counts[at.VARIABLES]]
        free = var[var[:, at.V_COLUMN] >= 0]
        dims = graph.dims[free[:, at.V_COLUMN]]
        for dim in np.unique(dims).tolist():
            rows = free[dims == dim]
            out[rows[:, at.V_SCALAR, None] + np.arange(dim)] = _diagonal(rows, dim)
        return out

    def largest(self) -> float:
        """The largest entry of Λ, which is on its diagonal, as Λ is positive semidefinite; 0 without any."""
        return float(self.data[: self.fill[1]].max(initial=0.0))

    def put_ones(self, graph: FactorGraph, variables: I64) -> I64:
        """Set zeros on the diagonal of Λ to one where they are of the free `variables`; gives where in `data`."""
        found = []
        for row in graph.var[variables]:
            entries = _diagonal(row[None], int(graph.dims[row[at.V_COLUMN]]))[0]
            found.append(entries[self.data[entries] == 0.0])
        entries = np.concatenate(found)
        self.data[entries] = 1.0
        return entries

    def relinearize(self, graph: FactorGraph, values: F64) -> float:
        """Build all anew at `values` in the spare copy; gives χ² there."""
        if self._spare_data.size != self.data.size or self._spare_eta.size != self.eta.size:
            self._spare_data, self._spare_eta = np.empty_like(self.data), np.empty_like(self.eta)
        self._spare_data[: self.fill[1]] = 0.0
        self._spare_eta[: graph.counts[at.SCALARS]] = 0.0
        factors = int(graph.counts[at.FACTORS])
        return float(
            linearize(0, factors, graph.var, graph.fac, values, graph.payload, self._spare_data, self._spare_eta)
        )

    def swap_lambda(self) -> None:
        """Exchange the present and the spare Λ."""
        self.data, self._spare_data = self._spare_data, self.data

    def swap_eta(self) -> None:
        """Exchange the present and the spare η."""
        self.eta, self._spare_eta = self._spare_eta, self.eta

    def forget(self, graph: FactorGraph, fill: tuple[int, int]) -> None:
        """Go back to the pattern that had `fill`; `graph` is back at that moment already.

        The numbers are summed anew.  They get the bits they had: factors are always added in the order of their ids.
        """
        remove_blocks(fill[0], int(self.fill[0]), self.table, self.pattern)
        self.fill[:] = fill
        self.relinearize(graph, graph.values)
        self.swap_lambda()
        self.swap_eta()

    def _reserve(self, blocks: int, scalars: int) -> None:
        need = int(self.fill[0]) + blocks
        if need > self.pattern.shape[1]:
            larger = np.empty((3, max(need, 2 * self.pattern.shape[1])), np.int64)
            larger[:, : self.fill[0]] = self.pattern[:, : self.fill[0]]
            self.pattern = larger
        if 2 * need > self.table.size:
            self.table = np.zeros(table_size(need), np.int64)
            enter_blocks(int(self.fill[0]), self.table, self.pattern)
        if scalars > self.eta.size:
            self.eta = with_room(self.eta, scalars)


def _diagonal(rows: I64, dim: int) -> I64:
    """(n, dim), where in Λ's numbers the diagonal entries of n free variables of `dim` scalars are."""
    return rows[:, at.V_DIAGONAL, None] + np.arange(0, dim * dim, dim + 1)
