"""How a solver is set up."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Any, Literal

from factorbus.solver.errors import BadOption
from factorbus.solver.modes import MODES, mode_named
from factorbus.solver.option_ranges import check_numbers
from factorbus.solver.tuning import Tuning

__all__ = ["MODES", "Options"]


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a Solver; the defaults are meant for every graph.

    mode            "bayes-tree": only the part of R that a step affects is computed again, and only variables that need
                    it are relinearized (MATH §9); "auto" is that.  "inc-l": R is updated, and computed anew when that
                    is better (2013 paper, Algorithm 1); "inc-l-b10", "inc-l-b100": the same with a batch after every 10
                    or 100 new variables and none in between; "all-batch": every step that solves factorizes anew
    backend         "blocks": block multifrontal Cholesky; "cholmod": CHOLMOD on scalars, through scikit-sparse
    clock           seconds, for the phases in the report; without one they are zero
    relinearize_threshold   bayes-tree: a variable waits to be relinearized once a factor of it has a linearization
                    error of more than this many of the residuals that factors of the map have on average (MATH §9.6).
                    Whatever it is, a step relinearizes until it has converged, so that relinearization is rarer where
                    converged_share is larger, too; math.inf: what convergence takes is all there is
    wildfire_threshold   bayes-tree: back-substitution goes on where δ is off by more than would add the square of this
                    as a share to χ², if all scalars were (MATH §9.7)
    converged_share a step has converged if what is left to gain is at most this share of χ² (MATH §9.6); it goes on for
                    up to ten rounds until it has, and one that raised χ² by more is replaced by Levenberg-Marquardt
                    from where the estimate stood
    max_rounds      bayes-tree: linear problems solved in one step, at most, once the step has converged
    step_budget     bayes-tree: what a step with something new may take, in units of which 10⁸ are about a millisecond
                    (MATH §9.10); 0: there is no bound.  New variables and factors are always eliminated, whatever that
                    takes; relinearization, what is far from the newest pose, and Levenberg-Marquardt where χ² rose wait
                    for later steps where they do not fit.  A step with nothing new, or that settles, has no bound;
                    that with nothing new has one where it is given it, `Solver.step(budget=...)`
    batch_tolerance all-batch: an ordinary step stops when the next one would lower χ² by less than this share of it
    incremental_tolerance   inc-l: the same, and a first step that would is not made.  The paper's tol, with the length
                    of δ measured in standard deviations: |δ|² = δᵀΛδ = dᵀd ≤ tol χ²  (MATH §8.5)
    max_iterations  all-batch, inc-l: at most this many tries (accepted or not) in an ordinary step; the next step goes
                    on.  The paper's maxIT
    initialize_locally   new variables first go where their own factors want them, the rest held
    tuning          what was tuned: `Tuning`

    Raises BadOption: a value is no number of its range, or no mode, backend or function.
    """

    mode: str = "auto"
    backend: Literal["blocks", "cholmod"] = "blocks"
    clock: Callable[[], float] | None = None
    relinearize_threshold: float = 5e-4
    wildfire_threshold: float = 0.016
    converged_share: float = 5e-4
    max_rounds: int = 3
    step_budget: float = 0.0
    batch_tolerance: float = 1e-6
    incremental_tolerance: float = 5e-5
    max_iterations: int = 10
    initialize_locally: bool = True
    tuning: Tuning = field(default_factory=Tuning)

    def __post_init__(self) -> None:
        mode_named(self.mode)
        if self.backend not in ("blocks", "cholmod"):
            raise BadOption("backend", repr(self.backend), '"blocks" or "cholmod"')
        if self.clock is not None and not callable(self.clock):
            raise BadOption("clock", repr(self.clock), "None, or a function that returns seconds")
        if not isinstance(self.tuning, Tuning):
            raise BadOption("tuning", repr(self.tuning), "a Tuning")
        check_numbers(self)
        small, big = self.tuning.small_loop_threshold, self.tuning.big_loop_threshold
        if not small <= big:
            names = "small_loop_threshold, big_loop_threshold"
            raise BadOption(names, f"{small}, {big}", "0 ≤ small_loop_threshold ≤ big_loop_threshold")

    @classmethod
    def of(cls, **settings: Any) -> "Options":
        """Options and tuning by name, in one: as `as_dict` tells them.

        Raises BadOption: there is no such name, or its value is not one.
        """
        for name in settings:
            if name not in OPTION_NAMES and name not in TUNING_NAMES:
                raise BadOption(name, "a name of no option", f"one of {', '.join((*OPTION_NAMES, *TUNING_NAMES))}")
        tuning = Tuning(**{name: value for name, value in settings.items() if name in TUNING_NAMES})
        return cls(**{name: value for name, value in settings.items() if name in OPTION_NAMES}, tuning=tuning)

    def as_dict(self) -> dict[str, Any]:
        """All settings but the clock, those of `tuning` beside the others, as plain types: what a solver reports."""
        settings = {name: getattr(self, name) for name in OPTION_NAMES if name != "clock"}
        return settings | {name: getattr(self.tuning, name) for name in TUNING_NAMES}


OPTION_NAMES = tuple(each.name for each in fields(Options) if each.name != "tuning")
TUNING_NAMES = tuple(each.name for each in fields(Tuning))
