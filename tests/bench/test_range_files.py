"""Range-aided data sets of GTSAM's wheel: the optimum is GTSAM's, and every step of a replay is at its batch optimum.

goats_15 and goats_16 are .pyfg files: an underwater robot and acoustic beacons.  Plaza1 and Plaza2 (a lawn mower and
radio beacons; Djugash, Hamner and Roth, 2009) are tables, of which the first poses are written as .pyfg here.

The wheel's BetweenFactorPose2 measures its error by the logarithm, ours is that of g2o (MATH (3.2)): another
objective, 2.8e-6 apart at the optimum of goats_16.  So GTSAM gets relative poses as a factor with our residual, and its
own ranges.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bench.every.judge import Judge
from bench.replays.columns import symmetric
from bench.replays.gtsam_factors import gtsam_factors

from factorbus.formats import read
from factorbus.proto.messages import Batch, Factors
from factorbus.solver import Options, Solver, solve_batch

DATA = Path(gtsam.__file__).parent / "Data"
GOATS = ("goats_15.pyfg", "goats_16.pyfg")
PLAZA = ("Plaza1_.mat", "Plaza2_.mat")
STEPS = 500
WORST = 1.002


def file_of(name: str, folder: Path) -> Path:
    """The data set as a .pyfg."""
    if not (DATA / name).exists():
        pytest.skip(f"this wheel of GTSAM has no {name} in {DATA}")
    return plaza(DATA / name, folder / f"{name}.pyfg") if name in PLAZA else DATA / name


def plaza(table: Path, path: Path) -> Path:
    """The first poses of a Plaza data set: odometry, and each range from the pose at or before its time."""
    tables = pytest.importorskip("scipy.io").loadmat(str(table))
    odometry, ways, far, beacons = tables["DRp"][:STEPS], tables["DR"], tables["TD"], tables["TL"]
    time = odometry[:, 0]
    lines = [f"VERTEX_SE2 {t:.6f} A{k} {x} {y} {h}" for k, (t, x, y, h) in enumerate(odometry.tolist())]
    lines += [f"VERTEX_XY L{int(name)} {x} {y}" for name, x, y in beacons.tolist()]
    for k, (_, way, turn) in enumerate(ways[: STEPS - 1].tolist()):
        lines.append(f"EDGE_SE2 {time[k]:.6f} A{k} A{k + 1} {way} 0 {turn} 0.0025 0 0 0.0025 0 0.0001")
    for t, _, name, z in far[far[:, 0] < time[-1]].tolist():
        pose = max(int(np.searchsorted(time, t, "right")) - 1, 0)
        lines.append(f"EDGE_RANGE {time[pose]:.6f} A{pose} L{int(name)} {z} 1")
    path.write_text("\n".join(lines) + "\n")
    return path


def gtsam_optimum(batch: Batch, estimate: Any) -> float:
    """χ² at the end of GTSAM's Levenberg-Marquardt from `estimate`."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for group in estimate:
        for key, row in zip(group.keys.tolist(), group.values, strict=True):
            values.insert(key, gtsam.Pose2(*row.tolist()) if group.kind == "se2" else row.copy())
    for group in batch.factors:
        for factor in relative_poses(group) if group.kind == "between_se2" else gtsam_factors(group):
            graph.add(factor)
    for key in (key for group in batch.variables if group.fixed for key in group.keys.tolist()):
        graph.add(gtsam.NonlinearEqualityPose2(key, values.atPose2(key)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-13)
    params.setAbsoluteErrorTol(1e-13)
    params.setMaxIterations(200)
    return 2 * graph.error(gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize())


def relative_poses(group: Factors) -> Iterator[Any]:
    """As GTSAM's factors with the residual (3.2): E = z⁻¹ a⁻¹ b as (x, y, θ)."""
    rows = zip(group.keys.tolist(), group.measured, symmetric(group.information), strict=True)
    for keys, z, information in rows:
        measured = gtsam.Pose2(*z.tolist())

        def error(_: Any, values: Any, jacobians: Any, ends: list[int] = keys, measured: Any = measured) -> np.ndarray:
            relative = values.atPose2(ends[0]).between(values.atPose2(ends[1]))
            E = measured.between(relative)
            if jacobians is not None:
                B = np.eye(3)
                B[:2, :2] = E.rotation().matrix()
                jacobians[0], jacobians[1] = -B @ relative.inverse().AdjointMap(), B
            return np.array([E.x(), E.y(), E.theta()])

        yield gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Information(information), keys, error)


@pytest.mark.parametrize("name", [*GOATS, *PLAZA])
def test_the_optimum_is_that_of_gtsam_s_levenberg_marquardt(tmp_path: Path, name: str) -> None:
    graph = read(file_of(name, tmp_path), strict=True)
    whole = graph.whole()
    ours = solve_batch(whole.variables, whole.factors)
    assert ours.converged
    assert ours.chi2 == pytest.approx(gtsam_optimum(whole, whole.variables), rel=1e-6)


@pytest.mark.parametrize("name", [*GOATS, *PLAZA])
def test_every_step_of_a_replay_is_at_its_batch_optimum(tmp_path: Path, name: str) -> None:
    graph = read(file_of(name, tmp_path), strict=True)
    solver, judge = Solver(Options()), Judge()
    converged = 0
    for batch in islice(graph.steps(), STEPS):
        judge.take_in(batch)
        solver.stage(batch)
        report = solver.step()
        if report.converged:
            converged += 1
            assert judge.look(solver.estimate()).ratio <= WORST, batch.variables[0].keys
    assert converged > 0.5 * min(STEPS, graph.poses)
    points = {key for group in solver.estimate() if group.kind == "point2" for key in group.keys.tolist()}
    assert len(points) == graph.landmarks, "every beacon has entered"
