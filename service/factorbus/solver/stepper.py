"""What the modes of solving differ in: how a step brings the estimate up to date with what is new in the graph."""

from typing import Protocol

from factorbus.solver.graph.factor_graph import Mark
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.report import StepReport


class Stepper(Protocol):
    """Solves for what is new in a graph, step by step: `bayes_tree.steps` and `inc_l.steps`.

    within: steps go no further than the bounds of numbers let them, rather than leave these
    """

    within: bool

    def step(self, settle: bool, budget: float = 0.0, always: bool = False) -> StepReport:
        """Solve for what is new; with `settle` until it has converged, else within `budget`, as `Options.step_budget`,
        and with `always` also where nothing is new.
        Raises Underconstrained, NotFinite; what is new is taken back then, and all is as it was, bit for bit."""
        ...

    @property
    def complete(self) -> bool:
        """Whether the last step left nothing for later ones."""
        ...

    def resume(self, settle: bool) -> StepReport:
        """The first step for a graph that was taken over: it goes on from the estimate, none of which is new."""
        ...

    def changed(self) -> I64:
        """The variables, ascending, whose values have other bits than before the last step, new ones included."""
        ...

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate, as of the last step."""
        ...

    @property
    def unfinished(self) -> bool:
        """Whether a step with nothing new may bring the estimate nearer to the optimum by what χ² shows."""
        ...

    @property
    def mark(self) -> Mark:
        """How much of the graph there was after the last step."""
        ...

    def restore(self, report: StepReport) -> None:
        """Put the values from before the last step, which gave `report`, back into the graph."""
        ...

    def memory_bytes(self) -> int:
        """Bytes in use for what solves."""
        ...
