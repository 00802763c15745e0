"""Gauss-Newton, and Levenberg-Marquardt where a step would raise χ².  MATH §6.

The problem is a protocol, so the rules that accept and stop can be read, and tested, apart from the graph.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from factorbus.solver.kernels.jit.compile import F64

_FIRST_DAMPING = 1e-5
_LEAST_DAMPING = 1e-7
_MOST_DAMPING = 1e12
# A predicted decrease below this share of χ², or below this, may be lost in the rounding of χ² itself.
_ROUNDING = 1e-11
_ROUNDING_FLOOR = 1e-12
_HALVES = 3  # of a step of Newton's
# Steps that gain less than this share of χ² are near the end; as many of Gauss-Newton's take the time of one of
# Newton's.
_NEAR, _MANY = 1e-3, 12
_LEAST_NORMAL = 2.0**-1022
# Below these δ, too, is rounding: a settled map that is settled again does not move.
_EXACT, _EXACT_FLOOR = 1e-21, 1e-24


class LeastSquares(Protocol):
    """A sum of squares at a linearization point."""

    def factorize(self, damping: float) -> int:
        """Factorize Λ + damping · diag Λ; −1, or the block column whose pivot failed."""
        ...

    def decrease(self) -> float:
        """dᵀd = δᵀη by the factor made last and the present gradient: what the model says a step takes off χ²."""
        ...

    def step(self) -> F64:
        """The δ of the last `decrease`."""
        ...

    def present_decrease(self, certain: float) -> float:
        """δᵀη, as `decrease`, with Λ of the present point, until the factor made last, which is that of another, says
        that no more than `certain` is left."""
        ...

    def newton_step(self) -> F64 | None:
        """δ by the Hessian of χ², terms of second order included, where R is that of an undamped Λ; None: it has none
        to give."""
        ...

    def linearize_at(self, step: F64) -> float:
        """χ² at x ⊞ δ, where it is linearized too, aside."""
        ...

    def accept(self) -> None:
        """Move to the point linearized last."""
        ...

    def keep(self) -> None:
        """Remember the present point."""
        ...

    def go_back(self) -> None:
        """Move to the point that was kept, and linearize there anew."""
        ...


class LinearizedLeastSquares(LeastSquares, Protocol):
    """A problem that can stay linearized where it was."""

    def accept_linear(self) -> float:
        """Move to the point linearized last, but keep the linear model.  Return what the true gradient there, with the
        old factor, says that another step would take off χ²."""
        ...

    def rest(self) -> None:
        """The gradient is that of the linear model from here on, which is zero."""
        ...


@dataclass(frozen=True, slots=True)
class StoppingRule:
    """When to stop: the next step would lower χ² by less than `batch_tolerance` χ² + `floor`; or after `limit` tries.

    reuse: the old factor makes another step while each is to gain less than this share of the one before.
    polish: this number of steps more at most, below what χ² can show, while each is to gain less than the one before.
    nonmonotone: where an undamped step would raise χ², it is made all the same, and others after it until χ² is lower
    than before them: at most this many in all.  If it never is, they are taken back, and damped ones follow.
    newton: where an undamped step would raise χ², one of Newton's is tried before damped ones; and where undamped ones
    near the end gain hardly less than the one before; until one of Newton's would raise χ².
    certain: what an old factor says is left is computed with Λ of the present point where it is more than this share
    of χ².
    """

    tolerance: float
    floor: float
    limit: int
    reuse: float = 0.0
    polish: int = 0
    nonmonotone: int = 0
    newton: bool = False
    certain: float = math.inf

    def is_negligible(self, decrease: float, chi2: float) -> bool:
        """Whether a decrease of χ² is not worth a step.  False for NaN."""
        return decrease <= self.tolerance * chi2 + self.floor

    def is_slow(self, decrease: float, last: float, chi2: float) -> bool:
        """Whether steps that gain this, and `last` before, have some way to go to where one is negligible."""
        if not 0.0 < decrease <= _NEAR * chi2 or not math.isfinite(last):
            return False
        left = decrease / max(self.tolerance * chi2 + self.floor, _LEAST_NORMAL)
        return decrease >= last or math.log(left) > _MANY * math.log(last / decrease)


@dataclass(slots=True)
class Minimization:
    """How a minimization went.

    failed: the block column whose pivot failed in the last factorization, or −1.  left: what the next undamped step
    would take off χ², as predicted last; infinite where that is not known.  linear: it was one step of the linear
    problem, which is solved, whether or not χ² has converged.
    """

    chi2: float
    damping: float
    iterations: int = 0
    factorizations: int = 0
    converged: bool = False
    failed: int = -1
    left: float = math.inf
    linear: bool = False


def minimize(
    problem: LeastSquares,
    chi2: float,
    damping: float,
    rule: StoppingRule,
    have_factor: bool = False,
    tell: Callable[[Minimization], None] = lambda _: None,
) -> Minimization:
    """Lower χ² from where `problem` stands until `rule` says stop.  At the end χ² is no higher than at the beginning.

    Each try: 1. factorize and solve for a step, unless the last factor gave one; 2. stop if it would gain nothing;
    3. linearize at its end; 4. accept it if χ² does not rise there, else factorize with more damping, or go over the
    hill where `rule` has non-monotone steps.  5. After an undamped step the old factor with the new gradient gives, for
    the price of one solve, what another step would gain: nothing, and the loop ends; little, and that step is tried as
    it is; else Λ has changed and is factorized anew.  6. After a damped step that gained nothing an undamped factor
    tells what is left: where residuals are large, undamped steps may lead away from the very optimum.
    With `have_factor` the loop begins with a factor that is there, as after an undamped step.  With non-monotone steps
    or Newton's it begins without `damping`, which counts once they have been taken back.
    tell: called after every step that was accepted, with what the step was damped by.
    """
    hills, newton = rule.nonmonotone, rule.newton
    begin, later = (0.0, damping) if hills or newton else (damping, 0.0)
    result = Minimization(chi2, begin)
    decrease, solved, fresh = problem.decrease() if have_factor else 0.0, have_factor, False
    last = math.inf
    for _ in range(rule.limit):
        if not solved:
            result.factorizations += 1
            result.failed = problem.factorize(result.damping)
            if result.failed >= 0:
                if _damp_more(result):
                    continue
                break
            decrease, fresh = problem.decrease(), True
        undamped = result.damping == 0.0
        result.left = decrease if undamped else math.inf
        if undamped and rule.is_negligible(decrease, result.chi2):
            result.converged = fresh or _is_certain(problem, result, rule)
            if result.converged:
                break
            solved = False
            continue
        if undamped and fresh:
            if newton and rule.is_slow(decrease, last, result.chi2):
                newton = _try_newton(problem, result)
                if newton:
                    tell(result)
                    last = math.inf
                    continue
                problem.decrease()
            last = decrease
        reached = problem.linearize_at(problem.step())
        solved = False
        if not reached <= result.chi2:
            if not fresh:
                continue
            result.converged = undamped and _is_rounding(decrease, result.chi2)
            if result.converged:
                break
            if undamped and hills:
                made = _go_over_hill(problem, result, reached, hills)
                hills = hills - made if made else 0
                if made:
                    tell(result)
                if made or newton:
                    continue
            elif undamped and newton:
                newton = _try_newton(problem, result)
                if newton:
                    tell(result)
                    continue
            if undamped and later > 0.0:
                result.damping, later = later, 0.0
                continue
            if not _damp_more(result):
                break
            continue
        problem.accept()
        result.iterations += 1
        gained, result.chi2 = result.chi2 - reached, reached
        tell(result)
        if not undamped and rule.is_negligible(gained, reached) and _is_optimum(problem, result, rule):
            result.converged = True
            break
        _damp_less(result, gained, expected=decrease)
        if undamped:
            decrease, fresh = problem.decrease(), False
            result.left = decrease
            if gained == 0.0:
                result.converged = True
                break
            solved = decrease <= rule.reuse * gained or rule.is_negligible(decrease, reached)
    else:
        # The last try may have been all that was needed.
        result.converged = (
            result.damping == 0.0
            and solved
            and rule.is_negligible(decrease, result.chi2)
            and _is_certain(problem, result, rule)
        )
    if result.converged and result.damping == 0.0 and rule.polish:
        _polish(problem, result, rule.polish)
    return result


def try_linear_step(problem: LinearizedLeastSquares, chi2: float, rule: StoppingRule) -> Minimization | None:
    """One step of the linear problem, whose Λ and R stay as they are; None: χ² would rise, or there is no R.

    Where the linear problem has nothing to gain nothing moves (`iterations` 0), and whether the true one would gain by
    a step stays as it was: `converged` is then False, and means nothing.
    """
    result = Minimization(chi2, 0.0, factorizations=1, linear=True)
    if problem.factorize(0.0) >= 0:
        return None
    if rule.is_negligible(problem.decrease(), chi2):
        return result
    reached = problem.linearize_at(problem.step())
    if not reached <= chi2:
        return None
    result.left = problem.accept_linear()
    result.chi2, result.iterations = reached, 1
    result.converged = rule.is_negligible(result.left, reached) and _is_certain(problem, result, rule)
    problem.rest()
    return result


def _is_certain(problem: LeastSquares, result: Minimization, rule: StoppingRule) -> bool:
    """Whether an undamped step would gain nothing, where the factor that says so is that of another point."""
    certain = rule.certain * result.chi2 + rule.floor
    if result.left > certain:
        result.left = problem.present_decrease(certain)
    return rule.is_negligible(result.left, result.chi2)


def _is_optimum(problem: LeastSquares, result: Minimization, rule: StoppingRule) -> bool:
    """Whether an undamped step would gain nothing, by a factor that is made for that."""
    result.factorizations += 1
    if problem.factorize(0.0) >= 0:
        if result.chi2 > rule.floor:
            return False
        result.left = result.chi2  # a step takes off no more than all of it
        return True
    result.left = problem.decrease()
    return rule.is_negligible(result.left, result.chi2)


def _go_over_hill(problem: LeastSquares, result: Minimization, reached: float, most: int) -> int:
    """Undamped steps whatever χ² does, until it is lower than that of `result`; else back.  `problem` has tried the
    first, which led to χ² `reached`.  Gives how many were made; 0: they were taken back.

    What turns by much in one step is far off in the model of the second order: χ² rises in the first step, as the
    turned parts are stretched, and the next ones make them right.  Damped steps go around that hill in hundreds.
    """
    problem.keep()
    for made in range(1, most + 1):
        if not math.isfinite(reached):
            break
        problem.accept()
        if reached < result.chi2:
            result.chi2, result.iterations = reached, result.iterations + made
            return made
        result.factorizations += 1
        if problem.factorize(0.0) >= 0 or _is_rounding(problem.decrease(), reached):
            break
        reached = problem.linearize_at(problem.step())
    problem.go_back()
    return 0


def _try_newton(problem: LeastSquares, result: Minimization) -> bool:
    """A step of Newton's, or the first of its halves that lowers χ²; False: none did."""
    step = problem.newton_step()
    if step is None:
        return False
    for _ in range(_HALVES + 1):
        reached = problem.linearize_at(step)
        if reached < result.chi2:
            problem.accept()
            result.chi2, result.iterations = reached, result.iterations + 1
            return True
        step = 0.5 * step
    return False


def _polish(problem: LeastSquares, result: Minimization, most: int) -> None:
    """Steps by the old factor, which is nearly that of the optimum: δ is exact to more digits than χ² has."""
    last = math.inf
    for _ in range(most):
        decrease = problem.decrease()
        if decrease <= _EXACT * result.chi2 + _EXACT_FLOOR or not decrease <= 0.9 * last:
            return
        reached = problem.linearize_at(problem.step())
        if not _is_rounding(reached - result.chi2, result.chi2):
            return
        problem.accept()
        result.iterations += 1
        result.chi2, last = reached, decrease


def _is_rounding(decrease: float, chi2: float) -> bool:
    """Whether χ² cannot show a decrease of this size."""
    return decrease <= _ROUNDING * chi2 + _ROUNDING_FLOOR


def _damp_more(result: Minimization) -> bool:
    """Ten times the damping; False: that has no use any more, and another try starts without any."""
    result.damping = max(10.0 * result.damping, _FIRST_DAMPING)
    if result.damping > _MOST_DAMPING:
        result.damping = 0.0
        return False
    return True


def _damp_less(result: Minimization, gained: float, expected: float) -> None:
    """After a good step: less damping where the model was right, more where it was poor."""
    if gained < 0.25 * expected:
        result.damping *= 2.0
    else:
        result.damping *= 0.1
    if result.damping < _LEAST_DAMPING:
        result.damping = 0.0
