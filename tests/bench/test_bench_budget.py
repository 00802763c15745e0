"""What `bench budget` says of a budget is so."""

import pytest
from bench.budget import compare, shown, stretches
from bench.replays.problems import Problem

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


def test_stretches_are_runs_of_steps() -> None:
    assert stretches([True, True, False, True]) == {"p50": 1.5, "p99": pytest.approx(1.99), "share": 0.75}
    assert stretches([False, False]) == {"p50": 0.0, "p99": 0.0, "share": 0.0}
