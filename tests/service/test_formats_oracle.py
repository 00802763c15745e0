"""What is written means the same to g2o, and what g2o means by an offset is what we read: χ² at the values."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorbus.formats import read, write_g2o
from factorbus.formats.rotations import compose_poses, inverse_poses
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver

g2o = pytest.importorskip("g2opy")

KINDS = (
    "prior_se2",
    "prior_se3",
    "prior_point2",
    "prior_point3",
    "between_se2",
    "between_se3",
    "landmark_se2",
    "landmark_se3",
    "position_se2",
    "position_se3",
    "bearing_se2",
)
FIRST = {"se2": symbol("x", 0), "se3": symbol("x", 10), "point2": symbol("l", 20), "point3": symbol("l", 30)}


def near(rng: np.random.Generator, kind: str, spread: float = 1.0) -> np.ndarray:
    """A value of a variable, or a measurement of the same size."""
    row = spread * rng.normal(size=VARIABLE_KINDS[kind].size)
    if kind == "se3":
        quat = np.array([*(0.2 * row[3:6]), 1.0])
        row[3:] = quat / np.linalg.norm(quat)
    return row


def measured(rng: np.random.Generator, name: str) -> np.ndarray:
    if name.startswith("position"):  # g2o has no antenna beside its pose
        return np.pad(rng.normal(size=FACTOR_KINDS[name].dim), (0, FACTOR_KINDS[name].dim))
    size = FACTOR_KINDS[name].size
    return near(rng, "se3") if size == 7 else rng.normal(size=size)


def random_graph(seed: int, kinds: tuple[str, ...]) -> Batch:
    """Three variables of each kind, all with values, and two factors of each of `kinds`."""
    rng = np.random.default_rng(seed)
    variables = tuple(
        Variables(kind, first + np.arange(3), np.array([near(rng, kind, 3.0) for _ in range(3)]))
        for kind, first in FIRST.items()
    )
    factors = []
    for name in (name for name in FACTOR_KINDS if name in kinds):
        kind = FACTOR_KINDS[name]
        rows = [rng.permutation(3)[: len(kind.connects)] for _ in range(2)]
        keys = np.array([[FIRST[end] + row[k] for k, end in enumerate(kind.connects)] for row in rows])
        roots = [rng.normal(size=(kind.dim, kind.dim)) + 2 * np.eye(kind.dim) for _ in rows]
        packed = np.array([(root.T @ root)[np.triu_indices(kind.dim)] for root in roots])
        factors.append(Factors(name, keys, np.array([measured(rng, name) for _ in rows]), packed))
    return Batch(variables, tuple(factors))


def our_chi2(batch: Batch) -> float:
    """Σ rᵀΩr at the values, by the solver."""
    held = tuple(group._replace(fixed=True) for group in batch.variables)
    solver = Solver(Options(mode="inc-l", max_iterations=0))
    solver.stage(Batch(held, batch.factors))
    solver.step()
    return solver.chi2()


def their_chi2(path: Path) -> float:
    """The same by g2o."""
    optimizer = g2o.SparseOptimizer()
    solver = g2o.BlockSolverX(g2o.LinearSolverEigenX())
    optimizer.set_algorithm(g2o.OptimizationAlgorithmLevenberg(solver))
    assert optimizer.load(str(path))
    optimizer.initialize_optimization()
    optimizer.compute_active_errors()
    return optimizer.active_chi2()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), kinds=st.sets(st.sampled_from(KINDS), min_size=1))
def test_what_is_written_is_the_same_graph_to_g2o_and_to_us(tmp_path: Path, seed: int, kinds: set[str]) -> None:
    batch = random_graph(seed, tuple(kinds))
    path = tmp_path / "a.g2o"
    assert write_g2o(path, batch, strict=True) == ()
    ours = our_chi2(batch)
    assert their_chi2(path) == pytest.approx(ours, rel=1e-9)
    again = read(path).batch
    assert our_chi2(again) == pytest.approx(ours, rel=1e-12)
    assert {key for group in again.variables for key in group.keys.tolist()} == {
        key for group in batch.variables for key in group.keys.tolist()
    }


# record and its ends: how many offsets it names, what it becomes, whether its weight is carried over exactly
OFFSET_RECORDS = {
    "EDGE_SE2_OFFSET 0 1": (2, "between_se2", False),
    "EDGE_SE2_POINTXY_OFFSET 0 2": (1, "landmark_se2", True),
    "EDGE_SE3_OFFSET 10 11": (2, "between_se3", False),
    "EDGE_SE3_TRACKXYZ 10 12": (1, "landmark_se3", True),
    "EDGE_SE3_PRIOR 10": (1, "prior_se3", False),
    "EDGE_SE3_XYZ_PRIOR 10": (1, "position_se3", True),
}


def offset_file(path: Path, record: str, rng: np.random.Generator, lever: float, error: float) -> None:
    """A file with one edge between sensors at an offset, measured with an error of about `error`."""
    offsets, name, _ = OFFSET_RECORDS[record]
    kind = FACTOR_KINDS[name]
    space = kind.connects[0]
    length = 2 if space == "se2" else 3
    places = np.array([near(rng, space), near(rng, space)])
    places[:, :length] *= lever
    poses = np.array([near(rng, space), near(rng, space)])
    if kind.size in (3, 7) and name != "landmark_se3":
        starts = poses[:1] if name.startswith("between") else None
        seen = compose_poses(poses[-1:], places[offsets - 1 :][:1])  # where the sensor is, or the second one
        z = seen if starts is None else compose_poses(inverse_poses(compose_poses(starts, places[:1])), seen)
        wrong = near(rng, space, error)
        if space == "se3":
            wrong[3:6] *= error
            wrong[3:] /= np.linalg.norm(wrong[3:])
        z = compose_poses(z, wrong[None])[0]
    else:
        z = rng.normal(size=kind.dim)
    root = rng.normal(size=(kind.dim, kind.dim)) + 2 * np.eye(kind.dim)
    information = (root.T @ root)[np.triu_indices(kind.dim)]
    first, vertex = (0, "VERTEX_SE2") if space == "se2" else (10, "VERTEX_SE3:QUAT")
    used = poses if name.startswith("between") else poses[-1:]
    path.write_text(
        "".join(f"PARAMS_{space.upper()}OFFSET {k} {words(place)}\n" for k, place in enumerate(places))
        + "".join(f"{vertex} {first + k} {words(pose)}\n" for k, pose in enumerate(used))
        + ("VERTEX_XY 2 1 2\n" if space == "se2" else "VERTEX_TRACKXYZ 12 1 2 3\n")
        + f"{record} {' '.join(map(str, range(offsets)))} {words(z)} {words(information)}\n"
    )


def words(numbers: np.ndarray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


@pytest.mark.parametrize("record", OFFSET_RECORDS)
@pytest.mark.parametrize("seed", range(4))
def test_an_offset_is_what_g2o_means_by_it(tmp_path: Path, record: str, seed: int) -> None:
    rng, path = np.random.default_rng(seed), tmp_path / "a.g2o"
    exact = OFFSET_RECORDS[record][2]
    offset_file(path, record, rng, lever=1.0 if exact else 0.0, error=0.5)
    assert our_chi2(read(path).batch) == pytest.approx(their_chi2(path), rel=1e-9)
    offset_file(path, record, rng, lever=1.0, error=1e-4)
    graph = read(path)
    assert our_chi2(graph.batch) == pytest.approx(their_chi2(path), rel=1e-3)
    assert any("to first order in the error" in note for note in graph.notes) != exact
