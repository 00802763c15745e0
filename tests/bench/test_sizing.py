"""`bench sizing` counts what there is: every delta once, and an estimate that grows by what a pose is."""

import sys
from pathlib import Path
from typing import Any

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from sizing import run, table


@pytest.fixture(scope="module")
def measured() -> dict[str, Any]:
    return run(["manhattan"], [20, 60], 1, 1)


def test_a_row_has_what_the_drive_had(measured: dict[str, Any]) -> None:
    first, last = measured["rows"]
    assert (first["poses"], last["poses"]) == (20, 60)
    assert first["factors"] >= 19
    assert last["estimate_bytes"] - first["estimate_bytes"] == pytest.approx(40 * 32, abs=16)  # x y θ and a key
    mean, p50, p99 = last["delta_bytes"]
    assert 32 < p50 <= p99
    assert mean < last["estimate_bytes"]
    assert last["idle_bytes"] > 50e6
    assert last["cpu_s"] > 0


def test_with_a_window_the_deltas_are_not_counted(measured: dict[str, Any]) -> None:
    (row,) = run(["manhattan"], [40], 8, 1)["rows"]
    assert row["delta_bytes"] is row["round_trip_ms"] is None
    assert row["estimate_bytes"] == pytest.approx(measured["rows"][0]["estimate_bytes"] + 20 * 32, abs=16)


def test_the_table_has_every_row(measured: dict[str, Any]) -> None:
    lines = table(measured).splitlines()
    assert [line.split()[:2] for line in lines[1:3]] == [["manhattan", "20"], ["manhattan", "60"]]
    assert "MB" in lines[3]
