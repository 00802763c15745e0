"""Where the covariances of a solver come from: its R in the mode "bayes-tree", else one that is made for them."""

from collections.abc import Callable
from functools import partial

from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.covariance.kernels.foreseen import foresee_closures
from factorbus.solver.covariance.live import Live
from factorbus.solver.covariance.square_root import (
    DIMS,
    SquareRoot,
    computed_square_root,
    copied_square_root,
    viewed_square_root,
)
from factorbus.solver.covariance.upkeep import Upkeep
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.closures.back import Bools
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.stepper import Stepper


class CovarianceSource:
    """R of a graph as of the last step, for covariances."""

    def __init__(self, graph: FactorGraph, stepper: Stepper) -> None:
        self._graph = graph
        self._steps = stepper if isinstance(stepper, TreeSteps) else None
        self._kept = Live(graph, self._steps.tree) if self._steps else None

    @property
    def _tree(self) -> CliqueTree | None:
        """Where R is; None: nowhere, or it is rounding in part, as pivots were raised."""
        return self._steps.tree if self._steps and not self._steps.tree.raised else None

    @property
    def _live(self) -> Live | None:
        return self._kept if self._tree else None

    def factored(self) -> SquareRoot:
        """A copy of R and of all that it is of, for other threads.

        In the mode "bayes-tree" that is its R, linearized where it is; in the others, and where pivots were raised, one
        made here, at the estimate.
        """
        return copied_square_root(self._graph, self._tree) if self._tree else computed_square_root(self._graph)

    def factoring(self) -> Callable[[], SquareRoot]:
        """What gives `factored` as of now, on any thread and later: R is copied here, or else what it is made from."""
        if self._tree:
            found = self.factored()
            return lambda: found
        return partial(computed_square_root, self._graph.copied())

    def try_view(self) -> SquareRoot | None:
        """The same without a copy, for questions about a few variables: until the next step, on the thread that steps.

        None: there is no R that could be read in place, or it is rounding in part; `factored` makes one.
        """
        return viewed_square_root(self._graph, self._tree) if self._tree else None

    def try_upkeep(self) -> Upkeep | None:
        """What keeps all diagonal blocks of the covariance up, updated after every step.  None: as for `try_view`."""
        return Upkeep(self._graph, self._tree) if self._tree else None

    def try_foresee(
        self, staged: I64, limits: F64, columns: tuple[F64, F64, F64], marks: tuple[I64, I64, Bools], out: F64
    ) -> int:
        """Judge loop closures before their step, as `foresee_closures` does; gives how many are believed, below 0: that
        cannot be done.

        marks: `ends`, `looked` and `is_tested` of a ledger.
        """
        if self._steps is None or (tree := self._steps.tree).raised:
            return -1
        ends, looked, is_tested = marks
        tables = self._graph.array_table, tree.array_table, DIMS, looked
        return foresee_closures(staged, tables, limits, columns, ends, is_tested, out)

    def try_contradicted(
        self, is_tested: Bools, looked_at: tuple[int, int, int], ends: I64, columns: tuple[F64, F64, F64], most: float
    ) -> int | None:
        """The loop closure that the map contradicts most, as `find_contradicted` says it.  None: as for `try_view`."""
        live = self._live
        return live.contradicted(is_tested, looked_at, ends, columns, most) if live else None

    def try_joint(self, variables: I64, scalars: int | None = None) -> F64 | None:
        """The joint covariance of a few different free variables (by index) as of the last step, read from R in place.

        scalars: of all of them, where that is known.  None: as for `try_view`.
        """
        return self._live.joint(variables, scalars) if self._live else None
