"""A step that says of itself that it is clear is not looked at again: its report is what a closer look gives."""

from contextlib import nullcontext

import pytest
from bench.every.drives import WORLDS

from factorbus.solver import Options, Solver

DRIVES = ("manhattan", "city_trees", "sphere", "outliers", "drift", "meetings_3d", "late_2d", "frames_3d")
TIMES = {"step_ms", "compiled_ms", "phases_ms"}


@pytest.mark.parametrize("budget", [0.0, 3000.0])
@pytest.mark.parametrize("world", DRIVES)
def test_reports_are_the_same_with_a_closer_look(world: str, budget: float) -> None:
    """Also with a budget, which leaves steps unconverged."""
    clear, looked_at = (Solver(Options(step_budget=budget)) for _ in range(2))
    converged, steps = 0, list(WORLDS[world].make(80, 4))
    for step in steps:
        reports = []
        for solver, around in ((clear, nullcontext()), (looked_at, looked_at.within_bounds())):
            solver.stage(step)
            with around:
                told = solver.step().as_dict()
            reports.append({name: told[name] for name in told if name not in TIMES})
        assert reports[0] == reports[1]
        converged += reports[0]["converged"]
    assert 0 < converged <= len(steps)
    assert converged < len(steps) or not budget or world in ("manhattan", "outliers", "drift")
