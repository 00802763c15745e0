"""`factorbus demo`: five processes, and what they say at the end."""

import json
import os
import re
import select
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorbus.cli.commands.demo import _rows
from factorbus.cli.driving.columns import merged, position_errors, positions
from factorbus.cli.driving.drive import Compared
from factorbus.cli.output.exits import FAILED, INTERRUPTED, OK
from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan

FACTORBUS = str(Path(sys.executable).with_name("factorbus"))


@pytest.mark.parametrize("world", ["manhattan", "city-trees", "sphere"])
def test_every_steps_estimate_reaches_everybody_and_is_as_good_as_a_batch(world: str, tmp_path: Path) -> None:
    ran = subprocess.run(
        [FACTORBUS, "demo", "--world", world, "--poses", "300", "--seed", "4", "--json"],
        cwd=tmp_path, capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    assert ran.returncode == OK, ran.stderr
    found = json.loads(ran.stdout)
    assert (found["poses"], found["steps"], found["revision"]) == (300, 300, 300)
    assert found["estimates_received"] == {"viewer": 300, "robot": 300}
    assert found["every_estimate_received"] is True
    assert (found["landmarks"] > 0) == (world == "city-trees") == (found["error_landmarks_m"] is not None)
    assert len(found["against_batch"]) >= 2
    assert found["against_batch"][-1]["revision"] == 300
    assert found["chi2_batch"] * (1 - 1e-6) < found["chi2"] < found["chi2_batch"] * 1.01
    assert found["chi2"] < found["chi2_initial"]
    assert found["error_m"]["rms"] < found["error_odometry_m"]["rms"]
    assert {each["worker"] for each in found["against_batch"]} <= {"worker1", "worker2"}
    assert set(found["processes"]) == {"solver", "robot", "worker1", "worker2"}
    assert len(set(found["processes"].values()) | {os.getpid()}) == 5
    assert (tmp_path / found["plot"]).read_bytes().startswith(b"\x89PNG")
    assert found["written"] == [found["plot"]]
    assert "300/300" in ran.stderr


def test_an_optimum_that_had_not_converged_is_told_at_the_end() -> None:
    spread, times = {"rms": 0.1, "max": 0.2}, {"p50": 1.0, "p99": 2.0, "max": 3.0}
    compared = [
        Compared(revision, 2.0, 1.99, "worker1", 0.5, "rotations", batch_converged=converged)
        for revision, converged in ((10, True), (20, False), (30, False))
    ]
    result: dict[str, Any] = {
        "against_batch": [each.as_dict() for each in compared], "poses": 30, "landmarks": 0, "factors": 40,
        "loop_closures": 3, "poses_per_s": 10.0, "seconds": 3.0, "steps": 30, "step_ms": times, "bus_ms": times,
        "chi2": 2.0, "chi2_initial": 9.0, "error_m": spread, "error_odometry_m": spread, "error_landmarks_m": None,
        "estimates_received": {"viewer": 30, "robot": 30}, "every_estimate_received": True, "plot": "demo.png",
    }  # fmt: skip
    told = dict(_rows(result))
    assert "averaged rotations, not converged, the true optimum may be lower" in told["χ² / batch optimum"]
    assert told["batch optimum"] == "2 times not converged, the true optimum may be lower"
    assert told["estimates received"] == "every one: 30 steps, 30 by the robot, 30 by the viewer"
    result |= {"estimates_received": {"viewer": 30, "robot": 28}, "every_estimate_received": False}
    missed = dict(_rows(result))["estimates received"]
    assert missed.startswith("30 steps, 28 by the robot, 30 by the viewer; where a step's delta came late")
    assert "every copy is complete at the end" in missed
    result["against_batch"] = [compared[0].as_dict()]
    assert "not converged" not in str(_rows(result))


@pytest.mark.parametrize(
    ("number", "whom", "code"),
    [
        (signal.SIGINT, "demo", INTERRUPTED),
        (signal.SIGKILL, "demo", -signal.SIGKILL),
        (signal.SIGKILL, "solver", FAILED),
        (signal.SIGKILL, "robot", FAILED),
    ],
)
def test_no_process_is_left_whichever_is_killed(number: int, whom: str, code: int, tmp_path: Path) -> None:
    with subprocess.Popen(
        [FACTORBUS, "demo", "--poses", "100000"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        line = next(line for line in process.stderr if line.startswith("on tcp/"))
        pids = {name: int(pid) for name, pid in re.findall(r"(\w+) (\d+)", line.partition(": ")[2])}
        watched = {name: os.pidfd_open(pid) for name, pid in pids.items()}
        os.kill(process.pid if whom == "demo" else pids[whom], number)
        _, error = process.communicate(timeout=90)
        for name, descriptor in watched.items():
            assert select.select([descriptor], [], [], 30)[0], f"the {name} process is still there"
            os.close(descriptor)
    assert process.returncode == code, error
    assert "Traceback" not in error
    if code == FAILED:
        assert f"the {whom} process ended with exit code -9" in error


def test_errors_are_distances_of_the_variables_in_both() -> None:
    truth = merged(_truths(20)).variables
    assert positions(truth, ("se2",))[1].shape == (20, 2)
    assert position_errors(truth, truth, ("se2",)).tolist() == [0.0] * 20
    shorter = merged(_truths(10)).variables
    moved = [group._replace(values=np.add(group.values, (3.0, 4.0, 0.0))) for group in shorter]
    assert position_errors(moved, truth, ("se2",)).tolist() == pytest.approx([5.0] * 10)
    assert position_errors(moved, truth, ("point2",)).size == 0


def _truths(poses: int) -> list[Batch]:
    return [Batch(step.truth) for step in manhattan(poses=poses, seed=1)]


def test_a_camera_s_rays_become_points(tmp_path: Path) -> None:
    ran = subprocess.run(
        [FACTORBUS, "demo", "monocular", "--frames", "60", "--features", "40", "--workers", "1", "--json"],
        cwd=tmp_path, capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    assert ran.returncode == OK, ran.stderr
    found = json.loads(ran.stdout)
    assert (found["frames"], found["points"]) == (60, 300)
    assert sum(found["made_by"].values()) > 0
    assert found["relative_depth"]["last"] < 0.1 < found["relative_depth"]["first"]
    assert found["inverse_depth_within_3_sigma"] >= 0.95
    assert found["error_m"]["rms"] < 0.05
    assert (tmp_path / found["plot"]).read_bytes().startswith(b"\x89PNG")
    assert "60/60" in ran.stderr
