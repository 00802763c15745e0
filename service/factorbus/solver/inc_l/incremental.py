"""R of Λ as it is needed: updated where that is cheap, made anew where it is not.  MATH §8.

R is in the fronts of the last full factorization, or in block rows once it has been updated, or not there at all
(haveR of the 2013 paper).  What solves may be older than Λ (the old factor for a new gradient), or damped.
"""

from enum import Enum

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph, Mark
from factorbus.solver.inc_l.block_factor import BlockFactor
from factorbus.solver.inc_l.strategy import Plan, choose
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.retract import inner
from factorbus.solver.options import Options
from factorbus.solver.report import Stopwatch
from factorbus.solver.sparse.blocks import HessianBlocks
from factorbus.solver.sparse.elimination import Elimination


class Where(Enum):
    """Where a factor is."""

    NOWHERE = 0
    FRONTS = 1
    ROWS = 2


class Incremental:
    """R and d, and solving with them."""

    NOT_KEPT = ("_options",)

    def __init__(self, elimination: Elimination, options: Options) -> None:
        self.elimination = elimination
        self.rows = BlockFactor()
        self._options = options
        self._have = Where.NOWHERE  # R of the present Λ, undamped, with d
        self._solves = Where.NOWHERE  # what factorize gave last
        self._d: F64 = np.empty(0)  # of the last `decrease`
        self._rows_have_d = False

    @property
    def where(self) -> Where:
        """Where the undamped R of the present Λ is."""
        return self._have

    @property
    def rows_have_d(self) -> bool:
        """Whether the block rows have d beside R."""
        return self._rows_have_d

    @property
    def have_r(self) -> bool:
        """Whether there is an undamped R of the present Λ."""
        return self._have is not Where.NOWHERE

    def memory_bytes(self) -> int:
        """Bytes of R, in fronts and in block rows."""
        return self.elimination.memory_bytes() + self.rows.memory_bytes()

    def apply(self, graph: FactorGraph, blocks: HessianBlocks, since: Mark, watch: Stopwatch) -> Plan:
        """R and d follow what came after `since`, which Λ and η hold already; or R is given up."""
        if not self.have_r:
            return Plan("full", "the linearization point has moved, or nothing was factorized yet")
        self._take()
        watch.lap("extract")
        self.rows.append(graph, since[at.VARIABLES])
        reach = self.rows.reach(graph, since[at.FACTORS])
        new, columns = int(graph.counts[at.FACTORS]) - since[at.FACTORS], int(graph.counts[at.COLUMNS])
        plan = choose(reach, new, columns, self._options)
        done = True
        if plan.strategy == "omega":
            done = reach.rows.size == 0 or self.rows.omega_update(graph, since[at.FACTORS], reach)
        elif plan.strategy == "lambda":
            done = self.rows.lambda_update(blocks, reach)
        else:
            self.moved()
        watch.lap(plan.strategy)
        if not done:
            self.moved()
            return Plan("full", f"a pivot failed in the {plan.strategy} update")
        return plan

    def factorize(self, graph: FactorGraph, blocks: HessianBlocks, damping: float, watch: Stopwatch) -> int:
        """R of Λ with its diagonal times 1 + damping, the one that is there if it is that; −1 or the failed column."""
        if damping == 0.0 and self.have_r:
            self._solves = self._have
            return -1
        if self._have is Where.FRONTS:
            self._have = Where.NOWHERE
        self._solves = Where.FRONTS
        failed = self.elimination.factorize(graph, blocks, damping, watch)
        if failed < 0 and damping == 0.0:
            self._have = Where.FRONTS
        return failed

    def serve(self) -> bool:
        """Solve with the R that is there, if there is one."""
        self._solves = self._have
        return self.have_r

    def decrease(self, eta: F64, watch: Stopwatch) -> float:
        """dᵀd, d = R⁻ᵀPη; the next `step` takes this d."""
        if self._solves is Where.ROWS:
            if self._have is Where.ROWS and self._rows_have_d:
                self._d = self.rows.d[: eta.size]
                squared = float(inner(self._d, self._d))
            else:
                self._d = np.empty(eta.size)
                squared = self.rows.forward(eta, self._d)
        else:
            self._d = self.elimination.forward(eta)
            squared = float(inner(self._d, self._d))
        watch.lap("solve")
        return squared

    def step(self, watch: Stopwatch) -> F64:
        """δ of the last `decrease`, in insertion order."""
        step = self.rows.back(self._d) if self._solves is Where.ROWS else self.elimination.back(self._d)
        watch.lap("solve")
        return step

    def turned(self) -> None:
        """η has changed; Λ has not."""
        self._rows_have_d = False

    def rest(self) -> None:
        """η and d are zero."""
        self._d = np.zeros(self._d.size)
        self._rows_have_d = False

    def least_pivot(self) -> float:
        """The least R_kk² of the factor made last."""
        return self.rows.least_pivot() if self._solves is Where.ROWS else self.elimination.least_pivot()

    def cost(self) -> tuple[int, float]:
        """Nonzeros of R, and the flops of its last factorization."""
        symbolic = self.elimination.symbolic
        nonzeros = symbolic.nnz_r if symbolic else 0
        return self.rows.nonzeros() if self._have is Where.ROWS else nonzeros, symbolic.flops if symbolic else 0.0

    def moved(self) -> None:
        """Λ has changed, R is not its factor any more."""
        self._have = Where.NOWHERE

    def forget(self) -> None:
        """The pattern of Λ was changed in a way that its size does not show."""
        self._have = self._solves = Where.NOWHERE
        self.elimination.forget()

    def _take(self) -> None:
        """R in block rows, with the d of the last `decrease`."""
        if self._have is Where.FRONTS:
            self.rows.take(*self.elimination.fronts(), self._d)
        elif not self._rows_have_d:
            self.rows.d[: self._d.size] = self._d
        self._have, self._rows_have_d = Where.ROWS, True
