"""The public data sets: every count of their table, their order, and what GTSAM's reader makes of them."""

from pathlib import Path

import numpy as np
import pytest

from factorbus.formats import GraphFile, read
from factorbus.proto.messages import Factors
from factorbus.proto.symbols import symbol_parts

pytestmark = pytest.mark.data

# poses, landmarks, pose-pose edges, landmark edges, vertex lines
TABLE = {
    "manhattan3500": (3500, 0, 5598, 0, 0),
    "w10000": (10000, 0, 64311, 0, 10000),
    "citytrees10000": (10000, 100, 9999, 4443, 0),
    "intel": (943, 0, 1837, 0, 943),
    "killian": (1941, 0, 3995, 0, 1941),
    "victoria_park": (6969, 151, 6968, 3640, 0),
    "killian_freiburg": (1941, 0, 3995, 0, 1941),
    "w10000_toro": (10000, 0, 64311, 0, 10000),
    "city10000": (10000, 0, 20687, 0, 0),
    "sphere2500": (2500, 0, 4949, 0, 2500),
    "parking_garage": (1661, 0, 6275, 0, 1661),
}


@pytest.mark.parametrize("name", TABLE)
def test_counts_and_order(datasets: Path, name: str) -> None:
    poses, landmarks, edges, observations, vertices = TABLE[name]
    graph = read(datasets / f"{name}.g2o")
    steps = list(graph.steps())
    assert sum(step.factor_count for step in steps) == graph.batch.factor_count
    counts = {group.kind: len(group.keys) for group in graph.batch.factors}
    between = "between_se3" if name in ("sphere2500", "parking_garage") else "between_se2"
    assert (graph.poses, graph.landmarks) == (poses, landmarks)
    assert (counts[between], counts.get("landmark_se2", 0)) == (edges, observations)
    assert sum(len(group.keys) for group in graph.batch.variables if group.values is not None) == vertices

    assert len(steps) == poses
    assert sum(step.variable_count for step in steps) == graph.batch.variable_count
    for k, group in enumerate(graph.batch.factors):  # the files are in time order: nothing may move
        replayed = [part for step in steps for part in step.factors if part.kind == group.kind]
        np.testing.assert_array_equal(np.concatenate([part.keys for part in replayed]), group.keys)
        np.testing.assert_array_equal(np.concatenate([part.measured for part in replayed]), group.measured)
        assert (np.diff(graph.factor_lines[k]) > 0).all()


def numbers(graph: GraphFile) -> tuple[Factors, np.ndarray]:
    """The edges between poses and their ids."""
    edges = graph.batch.factors[0]
    return edges, np.vectorize(lambda key: symbol_parts(key)[1])(edges.keys)


@pytest.mark.parametrize("name", ["intel", "victoria_park", "w10000_toro"])
def test_gtsam_reads_the_same_edges_in_the_plane(datasets: Path, name: str) -> None:
    gtsam = pytest.importorskip("gtsam")
    file = datasets / f"{name}.g2o"
    edges, ids = numbers(read(file))
    factors, _ = gtsam.readG2o(str(file), False)
    for k in range(0, factors.size(), 13):
        factor = factors.at(k)
        assert factor.keys() == ids[k].tolist()
        z = factor.measured()
        angle = np.remainder(edges.measured[k, 2] - z.theta() + np.pi, 2 * np.pi) - np.pi
        np.testing.assert_allclose([z.x(), z.y()], edges.measured[k, :2], rtol=1e-12)
        assert abs(angle) < 1e-12
        np.testing.assert_allclose(
            factor.noiseModel().information()[np.triu_indices(3)], edges.information[k], rtol=1e-9, atol=1e-9
        )


@pytest.mark.parametrize("name", ["sphere2500", "parking_garage"])
def test_gtsam_reads_the_same_edges_in_space(datasets: Path, name: str) -> None:
    gtsam = pytest.importorskip("gtsam")
    file = datasets / f"{name}.g2o"
    edges, ids = numbers(read(file))
    factors, _ = gtsam.readG2o(str(file), True)
    for k in range(0, factors.size(), 13):
        factor = factors.at(k)
        assert factor.keys() == ids[k].tolist()
        z, q = factor.measured(), factor.measured().rotation().toQuaternion()
        np.testing.assert_allclose(z.translation(), edges.measured[k, :3], rtol=1e-12)
        quat = np.array([q.x(), q.y(), q.z(), q.w()])
        assert abs(abs(quat @ edges.measured[k, 3:]) - 1) < 1e-12


def test_gtsams_copies_in_other_dialects(datasets: Path) -> None:
    """The TORO file that the g2o one was made from, and iSAM's sphere: same edges, and a weight that fits the noise."""
    gtsam = pytest.importorskip("gtsam")
    folder = Path(gtsam.__file__).parent / "Data"
    toro = read(folder / "w10000.graph")
    assert toro.notes == ("5875 EQUIV lines left out: equal poses stay joined by their edges",)
    whole = [group for step in toro.steps() for group in step.factors]  # the loops stand behind the odometry there
    edges, _ = numbers(read(datasets / "w10000_toro.g2o"))
    np.testing.assert_array_equal(np.concatenate([group.keys for group in whole]), edges.keys)
    np.testing.assert_array_equal(np.concatenate([group.information for group in whole]), edges.information)

    isam, (edges, ids) = read(folder / "sphere2500.txt"), numbers(read(datasets / "sphere2500.g2o"))
    assert isam.dialect == "isam"
    place = {tuple(pair): k for k, pair in enumerate(ids.tolist())}
    mine, mine_ids = numbers(isam)
    order = [place[tuple(pair)] for pair in mine_ids.tolist()]
    np.testing.assert_allclose(mine.measured, edges.measured[order], atol=1e-6)
    truth = np.loadtxt(datasets / "groundtruth" / "sphere2500_groundtruth.txt")[:, 1:]
    assert chi2_at(truth, mine, mine_ids) == pytest.approx(6 * len(ids), rel=0.01)  # consistent noise


def chi2_at(poses: np.ndarray, edges: Factors, ids: np.ndarray) -> float:
    """χ² of SE3 edges at given poses, by matrices."""

    def matrices(rows: np.ndarray) -> np.ndarray:
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        x, y, z, w = rows[:, 3:].T
        T[:, 0, :3] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1)
        T[:, 1, :3] = np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1)
        T[:, 2, :3] = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1)
        T[:, :3, 3] = rows[:, :3]
        return T

    T_w_i, T_w_j, T_i_j = (matrices(rows) for rows in (poses[ids[:, 0]], poses[ids[:, 1]], edges.measured))
    error = np.linalg.inv(T_i_j) @ np.linalg.inv(T_w_i) @ T_w_j
    w = np.sqrt(1 + np.trace(error[:, :3, :3], axis1=1, axis2=2)) / 2
    turn = [error[:, 2, 1] - error[:, 1, 2], error[:, 0, 2] - error[:, 2, 0], error[:, 1, 0] - error[:, 0, 1]]
    r = np.concatenate([error[:, :3, 3], np.stack(turn, 1) / (4 * w[:, None])], axis=1)
    information = np.zeros((len(r), 6, 6))
    rows, columns = np.triu_indices(6)
    information[:, rows, columns] = information[:, columns, rows] = edges.information
    return float(np.einsum("ni,nij,nj", r, information, r))
