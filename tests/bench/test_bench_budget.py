"""What `bench budget` says of a budget is so."""

import pytest
from bench.budget import compare, shown, stretches
from bench.budget_bus import together
from bench.replays.problems import Problem

from factorbus.simulate import manhattan

WORLD = Problem("manhattan", "streets", poses=400, seed=3)


def test_a_wide_budget_leaves_nothing_and_a_tight_one_does() -> None:
    wide, tight = compare(WORLD, 1000.0), compare(WORLD, 0.02)
    assert wide["steps_to_complete"]["share"] == 0.0
    assert wide["chi2_ratio"]["max"] == pytest.approx(1.0, rel=1e-6)
    assert wide["newest_pose_sigma"]["p99"] < 1e-3
    assert wide["work_share"]["max"] < 1.0
    assert tight["steps_to_complete"]["share"] > 0.02
    assert tight["chi2_ratio"]["max"] > 1.001
    for row in (wide, tight):
        assert row["poses"] == 400
        assert row["end_chi2"] == pytest.approx(0.0, abs=1e-6)
        assert row["step_ms"]["p50"] <= row["step_ms"]["p99"] <= row["step_ms"]["max"]
        assert "manhattan" in shown(row)


def test_the_rival_holds_back_what_does_not_fit() -> None:
    pytest.importorskip("gtsam")
    wide, tight = (compare(WORLD, budget_ms, with_rival=True)["rival"] for budget_ms in (1000.0, 0.02))
    for rival in (wide, tight):
        assert not rival["failed"]
        assert rival["chi2_ratio"]["p50"] > 1.0 - 1e-6, "nothing is below the optimum"
    assert wide["held_back_share"] == 0.0
    assert wide["chi2_ratio"]["p50"] < 1.001
    assert tight["held_back_share"] > 0.5
    assert tight["chi2_ratio"]["p95"] > wide["chi2_ratio"]["p95"]


def test_stretches_are_runs_of_steps() -> None:
    assert stretches([True, True, False, True]) == {"p50": 1.5, "p99": pytest.approx(1.99), "share": 0.75}
    assert stretches([False, False]) == {"p50": 0.0, "p99": 0.0, "share": 0.0}


def test_a_client_goes_on_with_keys_of_its_own_into_what_was_there_before() -> None:
    steps = [step.batch for step in manhattan(120, 5)]
    first = int(steps[60].variables[0].keys[0])
    made, plain = together(steps[60:], first, 1000), together(steps[60:])
    assert made.variables[0].keys.tolist() == [key + 1000 for key in plain.variables[0].keys.tolist()]
    for ours, theirs in zip(made.factors, plain.factors, strict=True):
        moved = ours.keys != theirs.keys
        assert (moved == (theirs.keys >= first)).all()
        assert (ours.keys[moved] - theirs.keys[moved] == 1000).all()
        assert ours.measured.tobytes() == theirs.measured.tobytes()
    assert sum(group.keys.shape[0] for group in plain.factors) == sum(batch.factor_count for batch in steps[60:])
