"""`solve_batch` with a search of one's own: its start, what it says on the way, a limit of memory, what it leaves."""

from collections.abc import Mapping

import pytest

from factorbus.simulate import Spiral, manhattan, sphere
from factorbus.solver import BatchSearch, Options, Solver, errors, solve_batch


class Heard:
    """All that was said."""

    def __init__(self) -> None:
        self.memory, self.starts = 0, dict[str, float]()
        self.iterations: list[tuple[str, int, float, float]] = []

    def on_memory(self, memory_bytes: int) -> None:
        self.memory = memory_bytes

    def on_starts(self, chi2: Mapping[str, float]) -> None:
        self.starts = dict(chi2)

    def on_iteration(self, start: str, iteration: int, chi2: float, damping: float) -> None:
        self.iterations.append((start, iteration, chi2, damping))


def town():
    """A drive that odometry alone leads far off."""
    return composed(manhattan(200, 2))


def composed(steps):
    """Variables with the values that odometry gives them, and factors."""
    solver = Solver(Options(mode="all-batch", max_iterations=0))
    for step in steps:
        solver.stage(step.batch)
    return solver.graph()


def test_averaged_rotations_that_were_nearly_the_optimum_leave_others_untried() -> None:
    variables, factors = composed(sphere(300, 1, spiral=Spiral(25, 12)))
    heard = Heard()
    found = solve_batch(variables, factors, BatchSearch(polish=False), heard)
    assert found.start == "rotations"
    assert heard.starts == found.starts
    assert found.starts["values"] > 10 * found.chi2
    assert {start for start, *_ in heard.iterations} == {"rotations"}
    assert [n for _, n, *_ in heard.iterations] == list(range(1, found.iterations + 1))
    assert heard.iterations[-1][2] == found.chi2
    assert 0 <= found.left <= 1e-10 * found.chi2


@pytest.mark.parametrize("start", ["values", "odometry", "rotations"])
def test_one_start(start: str) -> None:
    variables, factors = town()
    heard = Heard()
    found = solve_batch(variables, factors, BatchSearch(start, polish=False), heard)
    assert (found.start, list(heard.starts)) == (start, [start])
    assert found.chi2 == pytest.approx(solve_batch(variables, factors).chi2, rel=1e-9)


def test_what_needs_too_much_memory_is_refused_before_it_has_a_start() -> None:
    variables, factors = town()
    heard = Heard()
    with pytest.raises(errors.TooLarge, match="the limit is 1000"):
        solve_batch(variables, factors, BatchSearch(memory_limit_bytes=1000), heard)
    assert heard.memory > 1000
    assert not heard.starts
    assert solve_batch(variables, factors, BatchSearch(memory_limit_bytes=heard.memory)).converged


def test_a_start_that_does_not_exist_is_refused() -> None:
    with pytest.raises(errors.BadOption, match="best, values, rotations, odometry"):
        solve_batch(*town(), BatchSearch("luck"))
