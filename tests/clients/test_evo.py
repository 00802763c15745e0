"""evo reads our trajectories as they are, and its errors are ours."""

import json
import os
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from factorbus.cli.driving.columns import merged
from factorbus.cli.output.exits import OK
from factorbus.formats import write_kitti, write_tum
from factorbus.proto.messages import Batch, Variables
from factorbus.simulate import sphere
from factorbus.solver import solve_batch

SCRIPTS = Path(sys.executable).parent
pytestmark = pytest.mark.skipif(not (SCRIPTS / "evo_ape").exists(), reason="evo is not installed: make setup brings it")


def evo(tool: str, form: str, truth: Path, estimate: Path, *options: str) -> dict[str, float]:
    """The statistics of `evo_TOOL FORM TRUTH ESTIMATE`, unrounded."""
    results = estimate.with_name(f"{tool}.zip")
    ran = subprocess.run(
        [str(SCRIPTS / f"evo_{tool}"), form, str(truth), str(estimate), "--save_results", str(results), *options],
        env=os.environ | {"HOME": str(estimate.parent)}, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    with zipfile.ZipFile(results) as archive:
        return json.loads(archive.read("stats.json"))


def test_the_demos_trajectory_has_the_error_that_the_demo_says(tmp_path: Path) -> None:
    ran = subprocess.run(
        [str(SCRIPTS / "factorbus"), "demo", "--poses", "300", "--seed", "4", "--workers", "1", "--json",
         "--plot", "a.png", "--tum", "demo.tum", "--truth", "truth.tum"],
        cwd=tmp_path, capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    assert ran.returncode == OK, ran.stderr
    ours = json.loads(ran.stdout)["error_m"]
    found = evo("ape", "tum", tmp_path / "truth.tum", tmp_path / "demo.tum")
    assert found["rmse"] == pytest.approx(ours["rms"], abs=1e-6)
    assert found["max"] == pytest.approx(ours["max"], abs=1e-6)
    assert ours["rms"] > 1e-3


@pytest.mark.parametrize(("form", "write"), [("tum", write_tum), ("kitti", write_kitti)])
def test_errors_in_space_are_those_of_plain_matrices(form: str, write: Callable[..., None], tmp_path: Path) -> None:
    """A solved sphere beside its truth: |p − q|, and over one step E = (Qᵢ⁻¹ Qᵢ₊₁)⁻¹ (Pᵢ⁻¹ Pᵢ₊₁)."""
    steps = list(sphere(poses=120, seed=2))
    graph, truth = merged(step.batch for step in steps), Batch(merged(Batch(step.truth) for step in steps).variables)
    found = solve_batch(graph.variables, graph.factors).values
    estimate = Batch(tuple(Variables(group.kind, group.keys, group.values) for group in found))
    write(tmp_path / "truth", truth)
    write(tmp_path / "estimate", estimate)
    P, Q = matrices(estimate), matrices(truth)
    step = np.linalg.inv(np.linalg.inv(Q[:-1]) @ Q[1:]) @ np.linalg.inv(P[:-1]) @ P[1:]
    relative = evo("rpe", form, tmp_path / "truth", tmp_path / "estimate", "--delta", "1", "--delta_unit", "f")
    assert relative["rmse"] == pytest.approx(rms(step[:, :3, 3]), abs=1e-6)
    absolute = evo("ape", form, tmp_path / "truth", tmp_path / "estimate")
    assert absolute["rmse"] == pytest.approx(rms(P[:, :3, 3] - Q[:, :3, 3]), abs=1e-6)
    assert absolute["rmse"] > 0.1


def rms(rows: np.ndarray) -> float:
    return float(np.sqrt((rows**2).sum(axis=1).mean()))


def matrices(batch: Batch) -> np.ndarray:
    """Poses (n, 4, 4) in the order of their keys."""
    keys = np.concatenate([group.keys for group in batch.variables])
    values = np.concatenate([group.values for group in batch.variables if group.values is not None])[np.argsort(keys)]
    found = np.tile(np.eye(4), (len(values), 1, 1))
    v, w = values[:, 3:6], values[:, 6]
    zero = np.zeros(len(v))
    x, y, z = v.T
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    found[:, :3, :3] += 2 * (w[:, None, None] * cross + cross @ cross)  # Rodrigues, for a unit quaternion
    found[:, :3, 3] = values[:, :3]
    return found
