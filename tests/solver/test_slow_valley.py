"""Along a curved valley a step gains hardly less than the one before: what follows one that had not converged does not
say that it has before there is little left."""

from bench.every.drives import WORLDS

from factorbus.solver import Options, Solver
from factorbus.solver.divergence import copied

# Ranges to points on whose wrong side a drive was found, so that residuals are hundreds of σ; from this step on the
# minimum that the map was in is none any more.
SEED, FIRST, LAST = 1721504858, 124, 134


def reachable(solver: Solver) -> float:
    """The χ² to which a dozen steps that settle lead."""
    settled = copied(solver)
    return min(settled.step(settle=True).chi2 for _ in range(12))


def test_steps_behind_one_that_had_not_converged_say_it_only_where_it_is_so() -> None:
    solver, told = Solver(Options()), []
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
