"""Order, analysis and factorization of Λ.  What depends on its pattern only is kept while that stays.  MATH §5."""

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import POSE, SEES_LANDMARK
from factorbus.solver.options import Options
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.blocks import HessianBlocks
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.cholmod import factorize_by_cholmod
from factorbus.solver.sparse.dissection import analyze_whole
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze

_TIMES = 5  # that a whole graph is eliminated, about
# Groups of the constrained ordering.
_ANYWHERE, _RECENT_LANDMARK, _LAST_POSE = 0, 1, 2


class Elimination:
    """The factor R of Λ = Rᵀ R, with its arena, order and analysis."""

    NOT_KEPT = ("_options",)

    def __init__(self, options: Options) -> None:
        self._options = options
        self._cholesky = Cholesky()
        self._pattern = (0, 0)
        self.symbolic: Symbolic | None = None

    def factorize(self, graph: FactorGraph, blocks: HessianBlocks, damping: float, watch: Stopwatch) -> int:
        """Factorize Λ with its diagonal times 1 + damping; gives −1, or the block column whose pivot failed."""
        symbolic = self.analyze(graph, blocks, watch)
        if self._options.backend == "cholmod":
            failed = self._cholesky.take(
                symbolic,
                lambda arena: factorize_by_cholmod(
                    symbolic, blocks.rows, blocks.cols, blocks.data, blocks.offsets, damping, arena
                ),
            )
        else:
            failed = self._cholesky.factorize(symbolic, blocks.data, blocks.offsets, damping)
        watch.lap("numeric")
        return int(failed)

    def forward(self, eta: F64) -> F64:
        """d = R⁻ᵀPη by the factor made last, in elimination order."""
        return self._cholesky.forward(eta)

    def back(self, d: F64) -> F64:
        """δ = PᵀR⁻¹d, in insertion order."""
        return self._cholesky.back(d)

    def least_pivot(self) -> float:
        """The least R_kk² of the factor made last."""
        return self._cholesky.least_pivot()

    def memory_bytes(self) -> int:
        """Bytes of the fronts that were made last."""
        return 8 * self.symbolic.arena if self.symbolic else 0

    def fronts(self) -> tuple[Symbolic, F64]:
        """The factor made last: its analysis, and the arena with the numbers."""
        symbolic = self.symbolic
        if symbolic is None:
            raise ValueError("there is no factor: the pattern has changed since")
        return symbolic, self._cholesky.arena

    def analyze(self, graph: FactorGraph, blocks: HessianBlocks, watch: Stopwatch) -> Symbolic:
        """Order and analyse Λ, unless that is done."""
        pattern = (int(graph.counts[at.COLUMNS]), int(blocks.fill[0]))
        if self.symbolic is None or pattern != self._pattern:
            dims = graph.dims[: pattern[0]]
            self.symbolic, self._pattern = self._analyzed(graph, dims, blocks, watch), pattern
            watch.lap("symbolic")
        return self.symbolic

    def _analyzed(self, graph: FactorGraph, dims: I64, blocks: HessianBlocks, watch: Stopwatch) -> Symbolic:
        tuning = self._options.tuning
        group = constraint(graph, tuning.constrain_recent_poses) if tuning.constrain_last_pose else None
        perm = order(dims, blocks.rows, blocks.cols, group)
        watch.lap("order")
        return analyze(dims, blocks.rows, blocks.cols, perm)

    def forget(self) -> None:
        """The pattern was changed in a way that its size does not show."""
        self.symbolic = None


class WholeElimination(Elimination):
    """Of a graph that is eliminated as a whole, and not step by step: in whichever order takes least."""

    def _analyzed(self, graph: FactorGraph, dims: I64, blocks: HessianBlocks, watch: Stopwatch) -> Symbolic:
        return analyze_whole(dims, blocks.rows, blocks.cols, _TIMES)


def constraint(graph: FactorGraph, recent_poses: int = 1) -> I64:
    """Groups (columns,) of the ordering: the last free pose last, the landmarks seen from it, or from
    the `constrain_recent_poses` last ones, right before it.

    The next factors will most likely touch these, and changes near the end of the order are cheap (2013 paper, §5.2).
    """
    group = np.zeros(int(graph.counts[at.COLUMNS]), np.int64)
    var = graph.var[: graph.counts[at.VARIABLES]]
    poses = np.flatnonzero(POSE[var[:, at.V_KIND]] & (var[:, at.V_COLUMN] >= 0))
    if poses.size:
        fac = graph.fac[: graph.counts[at.FACTORS]]
        fac = fac[SEES_LANDMARK[fac[:, at.F_KIND]]]
        seen = fac[np.isin(fac[:, at.F_I], poses[-recent_poses:]), at.F_J]
        columns = var[seen, at.V_COLUMN]
        group[columns[columns >= 0]] = _RECENT_LANDMARK
        group[var[poses[-1], at.V_COLUMN]] = _LAST_POSE
    return group
