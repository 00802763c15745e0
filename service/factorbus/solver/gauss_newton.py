"""Gauss-Newton, and Levenberg-Marquardt where a step would raise χ².  MATH §6.

The problem is a protocol, so the rules that accept and stop can be read, and tested, apart from the graph.
"""

from dataclasses import dataclass
from typing import Protocol

from factorbus.solver.kernels._jit import F64

_FIRST_DAMPING = 1e-5
_LEAST_DAMPING = 1e-7
_MOST_DAMPING = 1e12
# A predicted decrease below this share of χ², or below this, may be lost in the rounding of χ² itself.
_ROUNDING = 1e-11
_ROUNDING_FLOOR = 1e-12


class Problem(Protocol):
    """A sum of squares at a linearisation point."""

    def factorize(self, damping: float) -> int:
        """Factorise Λ + damping · diag Λ; −1, or the block column whose pivot failed."""
        ...

    def step(self) -> tuple[F64, float]:
        """(δ, δᵀη) by the factor made last, with the present gradient: the undamped model's decrease of χ² is δᵀη."""
        ...

    def linearise_at(self, step: F64) -> float:
        """χ² at x ⊞ δ, where it is linearised too, aside."""
        ...

    def accept(self) -> None:
        """Move to the point linearised last."""
        ...


@dataclass(frozen=True, slots=True)
class Rule:
    """When to stop: the next step would lower χ² by less than `tolerance` χ² + `floor`; or after `limit` tries."""

    tolerance: float
    floor: float
    limit: int

    def is_negligible(self, decrease: float, chi2: float) -> bool:
        """Whether a decrease of χ² is not worth a step.  False for NaN."""
        return decrease <= self.tolerance * chi2 + self.floor


@dataclass(slots=True)
class Course:
    """How a minimisation went.  failed: the block column whose pivot failed in the last factorisation, or −1."""

    chi2: float
    damping: float
    iterations: int = 0
    factorisations: int = 0
    converged: bool = False
    failed: int = -1


def minimise(problem: Problem, chi2: float, damping: float, rule: Rule) -> Course:
    """Lower χ² from where `problem` stands until `rule` says stop.  χ² never rises.

    Each try: 1. factorise; 2. solve for the step; 3. linearise at its end; 4. accept it if χ² does not rise there,
    else try a shorter one.  After an accepted undamped step the old factor and the new gradient tell, for the price of
    one solve, what another step would gain; if that is negligible the loop ends without another factorisation.
    """
    course = Course(chi2, damping)
    for _ in range(rule.limit):
        course.factorisations += 1
        course.failed = problem.factorize(course.damping)
        if course.failed >= 0:
            if not _damp_more(course):
                return course
            continue
        step, decrease = problem.step()
        undamped = course.damping == 0.0
        if undamped and rule.is_negligible(decrease, course.chi2):
            course.converged = True
            return course
        reached = problem.linearise_at(step)
        if not reached <= course.chi2:
            if undamped and decrease <= _ROUNDING * course.chi2 + _ROUNDING_FLOOR:
                course.converged = True
                return course
            if not _damp_more(course):
                return course
            continue
        problem.accept()
        course.iterations += 1
        gained = course.chi2 - reached
        _damp_less(course, gained, expected=decrease)
        course.chi2 = reached
        if undamped and (gained == 0.0 or rule.is_negligible(problem.step()[1], reached)):
            course.converged = True
            return course
    return course


def _damp_more(course: Course) -> bool:
    """Ten times the damping; False: that has no use any more, and whoever tries again starts without any."""
    course.damping = max(10.0 * course.damping, _FIRST_DAMPING)
    if course.damping > _MOST_DAMPING:
        course.damping = 0.0
        return False
    return True


def _damp_less(course: Course, gained: float, expected: float) -> None:
    """After a good step: less damping where the model was right, more where it was poor."""
    if gained < 0.25 * expected:
        course.damping *= 2.0
    else:
        course.damping *= 0.1
    if course.damping < _LEAST_DAMPING:
        course.damping = 0.0
