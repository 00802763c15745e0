"""A strong and simple rival, made of our batch kernels: one Gauss-Newton step on a fresh block Cholesky at every loop.

No threshold, nothing kept: whenever a step brings more than new variables need, everything is linearized at the present
point, ordered, analysed, factorized and solved once, and all variables move.  In between poses are composed.
"""

from typing import Any

import numpy as np

from factorbus.proto.messages import Batch
from factorbus.solver import Group, SolverError
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.retract import move
from factorbus.solver.sparse.blocks import HessianBlocks
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze

from .columns import Values
from .contestants import Failed
from .ours import values_of


class GaussNewtonAtLoops:
    """What is on the clock: taking in the step, solving if it closes a loop, a copy of all values."""

    def __init__(self) -> None:
        self._graph, self._blocks, self._cholesky = FactorGraph(), HessianBlocks(), Cholesky()
        self._mark = self._graph.mark()
        self._batch = Batch()
        self._groups: list[Group] = []
        self._count = {"extend": 0, "batch": 0}
        self._nnz_r = 0

    def prepare(self, batch: Batch) -> None:
        """Columns are what the kernels take."""
        self._batch, self._groups = batch, []

    def step(self) -> None:
        """Raises Failed."""
        graph, since = self._graph, self._mark
        try:
            admit(graph, self._batch)
        except SolverError as problem:
            raise Failed(f"{problem.code}: {problem}") from problem
        self._blocks.extend(graph, since)
        self._mark = graph.mark()
        columns, factors = (self._mark[c] - since[c] for c in (at.COLUMNS, at.FACTORS))
        if factors <= columns:
            self._count["extend"] += 1
        else:
            self._solve()

    def read(self) -> None:
        """A copy of all values."""
        self._groups = self._graph.variables()

    def values(self) -> Values:
        """The same per kind."""
        return values_of(self._groups)

    def facts(self) -> dict[str, Any]:
        """nnz_r is of the last factor."""
        return {"nnz_r": self._nnz_r or None, "strategies": dict(self._count)}

    def _solve(self) -> None:
        graph, blocks = self._graph, self._blocks
        blocks.relinearize(graph, graph.values)
        blocks.swap_lambda()
        blocks.swap_eta()
        dims = graph.dims[: self._mark[at.COLUMNS]]
        symbolic = analyze(dims, blocks.rows, blocks.cols, order(dims, blocks.rows, blocks.cols))
        failed = self._cholesky.factorize(symbolic, blocks.data, blocks.offsets)
        if failed >= 0:
            raise Failed(f"the pivot of block column {failed} is not positive")
        delta = self._cholesky.solve(blocks.eta[: symbolic.size])
        moved = np.empty_like(graph.values)
        move(self._mark[at.VARIABLES], graph.var, graph.values, delta, moved)
        graph.values = moved
        self._nnz_r = symbolic.nnz_r
        self._count["batch"] += 1
