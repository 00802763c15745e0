"""The reported χ² is that of the estimate, and a step with nothing new does not raise it, in maps that contradict
themselves: a landmark ends on a pose that sees its bearing, where Λ is 10¹⁵ times what it was when its factors came."""

import pytest
from naive.dense_least_squares import DenseGraph
from naive.random_plane import contradicting_steps

from factorbus.solver import Options, Solver

_FURTHER = 12
_RISE = 1e-8  # of χ²: a step with nothing new goes on where more is left


@pytest.mark.parametrize("seed", [7, 40, 98, 295, 298, 338, 413, 505, 555, 686, 703, 794, 811])
def test_chi2_is_told_as_it_is_and_does_not_rise_by_itself(seed: int) -> None:
    solver, twin = Solver(Options()), DenseGraph()
    for batch in contradicting_steps(seed):
        solver.stage(batch)
        report = solver.step()
        twin.add(batch)
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-8, abs=1e-9)
    for _ in range(_FURTHER):
        report = solver.step()
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-8, abs=1e-9)
        assert report.chi2 <= report.chi2_before * (1 + _RISE) + 1e-12
