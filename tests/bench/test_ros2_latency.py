"""The measurement of the bridge to ROS 2 runs, and judges by its goal."""

import json
import subprocess
import sys
from pathlib import Path


def test_it_measures_and_judges() -> None:
    command = [sys.executable, str(Path(__file__).with_name("ros2.py")), "--rounds", "1", "--samples", "25", "--json"]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    assert ran.returncode in (0, 1), ran.stderr
    told = json.loads(ran.stdout)
    assert told["samples"] == 25
    assert 0 < told["after_step_ms"]["p50"] < told["odometry_to_transform_ms"]["p50"]
    assert 0 < told["after_step_floor_ms"]["p50"] < told["floor_ms"]["p50"]
    assert told["bytes"]["odometry"] > 700
    assert told["pose_ms"]["p50"] > 0
    slower = max(told["after_step_ms"]["p50"], told["pose_ms"]["p50"])
    assert (ran.returncode == 0) == (slower <= told["goal_ms"] == 5.0)
