"""Along a curved valley a step gains hardly less than the one before: what follows one that had not converged does not
say that it has before there is little left."""

import pytest
from bench.every.drives import WORLDS

from factorbus.solver import Options, Solver
from factorbus.solver.divergence import copied
from factorbus.solver.optimize import gauss_newton

# Ranges to a point whose place was found on the wrong side, so that residuals are hundreds of σ.
SEED, FIRST, LAST = 1468601439, 199, 204
# With which steps behind one that had not converged were met; with smaller ones the batch goes on there.
SHARES = {"relinearize_next_step_share": 3e-5, "relinearize_same_step_share": 3e-5}


def reachable(solver: Solver) -> float:
    """The χ² to which a dozen steps that settle lead."""
    settled = copied(solver)
    return min(settled.step(settle=True).chi2 for _ in range(12))


def test_steps_behind_one_that_had_not_converged_say_it_only_where_it_is_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """With damped steps alone: Newton's would end the valley."""
    monkeypatch.setattr(gauss_newton, "_try_newton", lambda *_: False)
    solver, told = Solver(Options.of(**SHARES)), []
    for k, batch in enumerate(WORLDS["ranges_2d"].make(300, SEED)):
        solver.stage(batch)
        report = solver.step()
        if FIRST <= k <= LAST:
            told.append(report.strategy)
            assert not report.converged or report.chi2 <= 1.001 * reachable(solver)
        if k == LAST:
            break
    assert "tree" in told
    assert report.chi2 > 1.003 * reachable(solver)
