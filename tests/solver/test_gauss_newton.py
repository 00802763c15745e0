"""The rules that accept, damp and stop, on small problems without a graph."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from factorbus.solver.optimize.gauss_newton import StoppingRule, minimize

SETTLE = StoppingRule(tolerance=1e-14, floor=1e-20, limit=200)


class Curve:
    """Residuals r(x) of a vector with a Jacobian; keeps what was asked of it."""

    def __init__(self, r: Callable, J: Callable, x: list[float]) -> None:
        self.r, self.J, self.x = r, J, np.array(x)
        self.chi2s = [self.chi2(self.x)]
        self.factorized: list[float] = []
        self.taken_back: list[np.ndarray] = []
        self.newtons = self.asked = 0

    def chi2(self, x: np.ndarray) -> float:
        return float(self.r(x) @ self.r(x))

    def factorize(self, damping: float) -> int:
        J = self.J(self.x)
        self.A = J.T @ J
        self.A += damping * np.diag(np.diag(self.A))
        self.factorized.append(damping)
        return -1 if np.linalg.eigvalsh(self.A)[0] > 1e-12 else 1

    def decrease(self) -> float:
        eta = -self.J(self.x).T @ self.r(self.x)
        self.delta = np.linalg.solve(self.A, eta)
        return float(self.delta @ eta)

    def step(self) -> np.ndarray:
        return self.delta

    def present_decrease(self, certain: float) -> float:
        """By A of the present point, whatever was factorized: nothing is left."""
        J, eta = self.J(self.x), self.gradient(self.x)
        self.asked += 1
        return float(eta @ np.linalg.solve(J.T @ J, eta))

    def newton_step(self) -> np.ndarray:
        """By the Hessian of χ² / 2, which is differences of its gradient."""
        h = 1e-6 * np.eye(self.x.size)
        columns = [(self.gradient(self.x + e) - self.gradient(self.x - e)) / 2e-6 for e in h]
        self.newtons += 1
        return np.linalg.solve(np.array(columns), -self.gradient(self.x))

    def gradient(self, x: np.ndarray) -> np.ndarray:
        return self.J(x).T @ self.r(x)

    def linearize_at(self, step: np.ndarray) -> float:
        self.there = self.x + step
        return self.chi2(self.there)

    def accept(self) -> None:
        self.x = self.there
        self.chi2s.append(self.chi2(self.x))

    def keep(self) -> None:
        self.kept = self.x

    def go_back(self) -> None:
        self.x = self.kept
        self.taken_back.append(self.x)


def rosenbrock(x: list[float]) -> Curve:
    return Curve(
        lambda x: np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]]), lambda x: np.array([[-20 * x[0], 10], [-1.0, 0]]), x
    )


def arctan(x: list[float]) -> Curve:
    """Gauss-Newton alone diverges from beyond ±1.39."""
    return Curve(lambda x: np.arctan(x), lambda x: np.array([[1 / (1 + x[0] ** 2)]]), x)


def test_a_linear_problem_takes_one_step_and_one_factorization() -> None:
    A, b = np.array([[2.0, 1], [0, 3], [1, 1]]), np.array([1.0, 2, 4])
    problem = Curve(lambda x: A @ x - b, lambda x: A, [0.0, 0.0])
    result = minimize(problem, problem.chi2s[0], 0.0, SETTLE)
    assert (result.iterations, result.factorizations, result.converged) == (1, 1, True)
    np.testing.assert_allclose(problem.x, np.linalg.lstsq(A, b, rcond=None)[0])


@pytest.mark.parametrize("start", [1.0, 3.0, 30.0, -1e3])
def test_damping_saves_what_gauss_newton_would_lose(start: float) -> None:
    problem = arctan([start])
    result = minimize(problem, problem.chi2s[0], 0.0, SETTLE)
    assert result.converged
    assert abs(problem.x[0]) < 1e-9
    assert (max(problem.factorized) > 0.0) == (abs(start) > 1.39)


@pytest.mark.parametrize("start", [[-1.2, 1.0], [0.0, 0.0], [-3.0, -4.0], [100.0, -50.0]])
def test_chi2_never_rises(start: list[float]) -> None:
    problem = rosenbrock(start)
    result = minimize(problem, problem.chi2s[0], 0.0, SETTLE)
    assert result.converged
    np.testing.assert_allclose(problem.x, [1.0, 1.0], atol=1e-8)
    assert (np.diff(problem.chi2s) <= 0.0).all()
    assert result.chi2 == problem.chi2s[-1]


OVER_HILLS = dataclasses.replace(SETTLE, nonmonotone=5)


def test_over_a_hill_there_are_few_steps_where_damped_ones_go_around_it() -> None:
    """From the classical start Gauss-Newton goes to (1, -3.84), which is a hundred times higher, and then to (1, 1)."""
    around, over = rosenbrock([-1.2, 1.0]), rosenbrock([-1.2, 1.0])
    minimize(around, around.chi2s[0], 0.0, SETTLE)
    result = minimize(over, over.chi2s[0], 0.0, OVER_HILLS)
    assert over.chi2s[1] > 50 * over.chi2s[0]
    np.testing.assert_allclose(over.x, [1.0, 1.0], atol=1e-9)
    assert (result.iterations, result.converged, over.factorized, over.taken_back) == (2, True, [0.0] * 3, [])
    assert result.chi2 == over.chi2s[-1]
    assert len(around.factorized) > 10


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_steps_that_never_lead_down_are_taken_back(damping: float) -> None:
    """Once; then the damping that was given counts."""
    problem = arctan([3.0])
    result = minimize(problem, problem.chi2s[0], damping, OVER_HILLS)
    assert result.converged
    assert abs(problem.x[0]) < 1e-9
    assert [x.tolist() for x in problem.taken_back] == [[3.0]]
    first_damped = next(n for n, used in enumerate(problem.factorized) if used)
    assert 1 < first_damped <= 1 + OVER_HILLS.nonmonotone
    assert problem.factorized[first_damped] == (damping or 1e-5)
    assert result.chi2 <= problem.chi2s[0]


NEWTON = dataclasses.replace(SETTLE, newton=True)


def between_two_ranges() -> Curve:
    """x of a point between two ranges that are a fifth of what they can be, and a weak wish of where it is: the
    curvature of χ² is four times what Jacobians say."""

    def r(x: np.ndarray) -> np.ndarray:
        d = np.hypot(5.0, x[0])
        return np.array([d - 1.0, d - 1.0, np.sqrt(0.5) * (x[0] - 0.3)])

    return Curve(r, lambda x: np.array([[x[0] / np.hypot(5.0, x[0])]] * 2 + [[np.sqrt(0.5)]]), [0.3])


def test_steps_of_newtons_end_where_gauss_newton_leads_away_from_the_optimum() -> None:
    damped, curved = between_two_ranges(), between_two_ranges()
    minimize(damped, damped.chi2s[0], 0.0, SETTLE)
    result = minimize(curved, curved.chi2s[0], 0.0, NEWTON)
    assert result.converged
    assert abs(curved.gradient(curved.x)[0]) < 1e-6
    assert curved.chi2s == sorted(curved.chi2s, reverse=True)
    assert len(curved.factorized) < len(damped.factorized) / 3
    assert set(curved.factorized) == {0.0}


def test_steps_of_newtons_come_where_those_of_gauss_newton_gain_little_each() -> None:
    """Two ranges that are longer than can be push outwards: the curvature of χ² is a fifth of what Jacobians say."""

    def r(x: np.ndarray) -> np.ndarray:
        d = np.hypot(5.0, x[0])
        return np.array([d - 9.0, d - 9.0, np.sqrt(2.0) * (x[0] - 0.01)])

    def jacobian(x: np.ndarray) -> np.ndarray:
        return np.array([[x[0] / np.hypot(5.0, x[0])]] * 2 + [[np.sqrt(2.0)]])

    slow, quick = Curve(r, jacobian, [0.01]), Curve(r, jacobian, [0.01])
    assert minimize(slow, slow.chi2s[0], 0.0, SETTLE).converged
    assert minimize(quick, quick.chi2s[0], 0.0, NEWTON).converged
    assert 0 < quick.newtons <= 3
    assert len(quick.factorized) < len(slow.factorized) / 3
    assert set(quick.factorized) == {0.0}
    np.testing.assert_allclose(quick.x, slow.x, atol=1e-5)


def test_far_from_the_end_there_are_none_however_little_steps_gain() -> None:
    rule = dataclasses.replace(NEWTON, tolerance=1e-11)
    assert not rule.is_slow(decrease=0.1, last=0.1, chi2=1.0)
    assert not rule.is_slow(decrease=1e-5, last=np.inf, chi2=1.0)
    assert not rule.is_slow(decrease=1e-8, last=1e-5, chi2=1.0)
    assert rule.is_slow(decrease=1e-5, last=2e-5, chi2=1.0)
    assert rule.is_slow(decrease=2e-5, last=1e-5, chi2=1.0)
    assert not rule.is_slow(decrease=1e-300, last=1e300, chi2=1e-290)


def test_where_undamped_steps_lead_down_there_are_none_of_newtons() -> None:
    problem = Curve(lambda x: np.exp(x) - 1.0, lambda x: np.diag(np.exp(x)), [0.5])
    assert minimize(problem, problem.chi2s[0], 0.0, NEWTON).converged
    assert problem.newtons == 0


def test_damped_steps_follow_the_first_of_newtons_that_does_not_lead_down() -> None:
    """At 3 the second derivative of arctan² is negative: the step goes uphill, and so do its halves."""
    problem = arctan([3.0])
    result = minimize(problem, problem.chi2s[0], 0.5, NEWTON)
    assert result.converged
    assert abs(problem.x[0]) < 1e-9
    assert problem.newtons == 1
    assert problem.factorized[:2] == [0.0, 0.5]


@pytest.mark.parametrize(("certain", "iterations", "asked"), [(np.inf, 1, 0), (1e-7, 1, 0), (1e-9, 2, 2)])
def test_what_an_old_factor_says_is_left_is_computed_at_the_present_point(
    certain: float, iterations: int, asked: int
) -> None:
    """J of x² halves with every step, so an old factor says that a quarter of what is left is left."""
    problem = Curve(lambda x: np.array([1.0, 0.3 * x[0] ** 2]), lambda x: np.array([[0.0], [0.6 * x[0]]]), [0.09])
    result = minimize(problem, problem.chi2s[0], 0.0, StoppingRule(2e-7, 0.0, limit=10, certain=certain))
    assert (result.converged, result.iterations, problem.asked) == (True, iterations, asked)
    left = problem.present_decrease(0.0)
    assert result.left == pytest.approx(left if asked else 0.25 * left)


def test_what_another_step_would_take_off_is_told() -> None:
    problem = rosenbrock([0.0, 0.0])
    result = minimize(problem, problem.chi2s[0], 0.0, StoppingRule(1e-6, 1e-12, limit=1))
    assert result.left == pytest.approx(problem.decrease())
    assert minimize(arctan([30.0]), 2.4, 1.0, StoppingRule(1e-6, 1e-12, limit=1)).left == np.inf


def test_a_limit_stops_and_the_damping_is_handed_on() -> None:
    problem = arctan([1e3])
    result = minimize(problem, problem.chi2s[0], 0.0, StoppingRule(1e-6, 1e-12, limit=2))
    assert (result.converged, result.factorizations) == (False, 2)
    assert result.damping > 0.0
    again = minimize(problem, problem.chi2s[-1], result.damping, SETTLE)
    assert again.converged


def test_the_loop_ends_where_another_step_would_gain_nothing() -> None:
    problem = rosenbrock([1.0 + 1e-9, 1.0])
    result = minimize(problem, problem.chi2s[0], 0.0, StoppingRule(1e-6, floor=1e-12, limit=10))
    assert (result.iterations, result.converged) == (0, True)


def test_a_singular_system_is_reported_not_moved() -> None:
    problem = Curve(lambda x: np.array([x[0] - 1.0]), lambda x: np.array([[1.0, 0.0]]), [5.0, 5.0])
    result = minimize(problem, 16.0, 0.0, SETTLE)
    assert (result.failed, result.iterations, result.converged) == (1, 0, False)
    assert result.damping == 0.0
    np.testing.assert_array_equal(problem.x, [5.0, 5.0])


def test_nan_beyond_the_step_is_a_step_too_far() -> None:
    with np.errstate(invalid="ignore"):
        problem = Curve(lambda x: np.sqrt(x) - 0.1, lambda x: np.array([[0.5 / np.sqrt(x[0])]]), [4.0])
        result = minimize(problem, problem.chi2s[0], 0.0, SETTLE)
    assert result.converged
    assert problem.x[0] == pytest.approx(0.01, rel=1e-6)
