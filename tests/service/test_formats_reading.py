"""Reading graph files: what each record becomes, and which dialect a file is taken for."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from factorbus.formats import GraphFile, read
from factorbus.formats.rotations import quat_xyzw, rotate_vectors
from factorbus.proto.messages import Factors, Variables
from factorbus.proto.symbols import symbol

INFO3 = "1 0 0 2 0 3"
INFO6 = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))


def x(*numbers: int) -> list[int]:
    return [symbol("x", number) for number in numbers]


def points(*numbers: int) -> list[int]:
    return [symbol("l", number) for number in numbers]


def read_text(folder: Path, text: str, name: str = "a.g2o", dialect: str | None = None) -> GraphFile:
    path = folder / name
    path.write_bytes(text.encode())
    return read(path, dialect)


def factors(graph: GraphFile, kind: str) -> Factors:
    return next(group for group in graph.batch.factors if group.kind == kind)


def variables(graph: GraphFile, kind: str, fixed: bool = False, valued: bool = True) -> Variables:
    return next(
        group
        for group in graph.batch.variables
        if (group.kind, group.fixed, group.values is not None) == (kind, fixed, valued)
    )


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_g2o_in_the_plane(tmp_path: Path, end: str) -> None:
    text = (
        "# a comment\nVERTEX_SE2 0 1 2 0.5\n\n   VERTEX_XY 7 3 4\nFIX 0\n"
        f"EDGE_SE2 0 3 1 0 0.1 {INFO3}\n\tEDGE_SE2_XY 3 7 5 6 1 0.5 2\nEDGE_PRIOR_SE2 3 1 1 1 {INFO3}"
    )
    graph = read_text(tmp_path, text.replace("\n", end))
    assert graph.dialect == "g2o"
    assert (graph.poses, graph.landmarks) == (2, 1)
    np.testing.assert_array_equal(variables(graph, "se2", fixed=True).values, [[1, 2, 0.5]])
    np.testing.assert_array_equal(variables(graph, "se2", valued=False).keys, x(3))
    np.testing.assert_array_equal(variables(graph, "point2").keys, points(7))
    edge = factors(graph, "between_se2")
    np.testing.assert_array_equal(edge.keys, [x(0, 3)])
    np.testing.assert_array_equal(edge.measured, [[1, 0, 0.1]])
    np.testing.assert_array_equal(edge.information, [[1, 0, 0, 2, 0, 3]])
    observation = factors(graph, "landmark_se2")
    np.testing.assert_array_equal(observation.keys, [[x(3)[0], points(7)[0]]])
    np.testing.assert_array_equal(observation.information, [[1, 0.5, 2]])
    np.testing.assert_array_equal(factors(graph, "prior_se2").keys, [x(3)])
    assert [lines.tolist() for lines in graph.factor_lines] == [[8], [6], [7]]


def test_g2o_in_space(tmp_path: Path) -> None:
    graph = read_text(
        tmp_path,
        "PARAMS_SE3OFFSET 4 0 0 0 0 0 0 1\nPARAMS_SE3OFFSET 5 1 0 0 0 0 0 1\n"
        "VERTEX_SE3:QUAT 0 0 0 0 0 0 0.70711 0.70711\nVERTEX_TRACKXYZ 2 1 2 3\n"
        f"EDGE_SE3:QUAT 0 1 1 2 3 0 0 0 -1 {INFO6}\nEDGE_SE3_TRACKXYZ 1 2 4 1 2 3 1 0 0 1 0 1\n"
        f"EDGE_SE3_PRIOR 0 4 0 0 0 0 0 0 1 {INFO6}\nEDGE_POINTXYZ_PRIOR 2 1 2 3 1 0 0 1 0 1\n",
    )
    pose = variables(graph, "se3").values
    assert pose is not None
    assert abs(np.linalg.norm(pose[0, 3:]) - 1) < 1e-15
    np.testing.assert_array_equal(factors(graph, "between_se3").measured, [[1, 2, 3, 0, 0, 0, -1]])
    np.testing.assert_array_equal(factors(graph, "landmark_se3").keys, [[x(1)[0], points(2)[0]]])
    np.testing.assert_array_equal(factors(graph, "landmark_se3").measured, [[1, 2, 3]])
    np.testing.assert_array_equal(factors(graph, "prior_se3").keys, [x(0)])
    np.testing.assert_array_equal(factors(graph, "prior_point3").keys, [points(2)])


def test_toro_has_its_own_order_of_information(tmp_path: Path) -> None:
    graph = read_text(
        tmp_path,
        "VERTEX2 0 0 0 0\nVERTEX2 1 1 0 0\nEDGE2 0 1 1 0 0  10 1 20 30 2 3\nEQUIV 0 1\nBR 1 9 0.5 4 0.1 0.5\n",
        "a.graph",
    )
    assert graph.dialect == "toro"
    assert graph.notes == ("1 EQUIV lines left out: equal poses stay joined by their edges",)
    np.testing.assert_array_equal(factors(graph, "between_se2").information, [[10, 1, 2, 20, 3, 30]])
    np.testing.assert_array_equal(factors(graph, "bearing_range_se2").measured, [[0.5, 4]])
    np.testing.assert_allclose(factors(graph, "bearing_range_se2").information, [[100, 0, 4]], rtol=1e-15)


def test_isam_has_square_roots_and_numbers_points_apart(tmp_path: Path) -> None:
    graph = read_text(
        tmp_path,
        "ODOMETRY 0 1 1 0 0  2 1 0 3 0 4\nEDGE2 1 2 1 0 0  1 0 0 1 0 1\nLANDMARK 1 0 5 6  2 1 3\n",
        "a.txt",
    )
    assert graph.dialect == "isam"
    root = np.array([[2, 1, 0], [0, 3, 0], [0, 0, 4.0]])
    np.testing.assert_array_equal(factors(graph, "between_se2").information[0], (root.T @ root)[np.triu_indices(3)])
    np.testing.assert_array_equal(factors(graph, "landmark_se2").keys, [[x(1)[0], points(0)[0]]])
    np.testing.assert_array_equal(factors(graph, "landmark_se2").information, [[4, 2, 10]])
    assert (graph.poses, graph.landmarks) == (3, 1)


def test_isam_turns_by_yaw_then_pitch_then_roll() -> None:
    angles = np.array([[0.3, -0.4, 2.5]])
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles[0]), np.sin(angles[0])
    turn = (
        np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        @ np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    )
    quat = np.repeat(quat_xyzw(angles), 3, axis=0)
    np.testing.assert_allclose(rotate_vectors(quat, np.eye(3)).T, turn, atol=1e-15)


def rpy(quat: np.ndarray) -> np.ndarray:
    qx, qy, qz, qw = quat
    return np.array(
        [
            np.arctan2(2 * (qw * qx + qy * qz), 1 - 2 * (qx * qx + qy * qy)),
            np.arcsin(2 * (qw * qy - qz * qx)),
            np.arctan2(2 * (qw * qz + qx * qy), 1 - 2 * (qy * qy + qz * qz)),
        ]
    )


def times(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    vector = p[3] * q[:3] + q[3] * p[:3] + np.cross(p[:3], q[:3])
    return np.array([*vector, p[3] * q[3] - p[:3] @ q[:3]])


@pytest.mark.parametrize("ends", ["0 1", "1 0"])
def test_isam_weight_of_angles_becomes_that_of_the_quaternion(tmp_path: Path, ends: str) -> None:
    """For a small error v the weight of 2v in our terms is iSAM's weight of the change of yaw, pitch and roll."""
    rng = np.random.default_rng(5)
    root = np.triu(rng.uniform(-1, 1, (6, 6))) + 6 * np.eye(6)
    measured = [1, 2, 3, 0.3, -0.4, 2.5]
    numbers = " ".join(repr(float(v)) for v in [*measured, *root[np.triu_indices(6)]])
    graph = read_text(tmp_path, f"EDGE3 {ends} {numbers}\n", "a.txt")
    edge = factors(graph, "between_se3")
    np.testing.assert_array_equal(edge.keys, [x(0, 1)])
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = edge.information[0]
    full += np.triu(full, 1).T

    isam_root = root.copy()  # what iSAM builds: the rotation part with yaw first, turned over its other diagonal
    isam_root[3:, 3:] = root[3:, 3:][::-1, ::-1].T
    error = 1e-7 * rng.uniform(-1, 1, 6)
    z = edge.measured[0]
    moved = times(z[3:], np.array([*error[3:], np.sqrt(1 - error[3:] @ error[3:])]))
    change = np.array([*error[:3], *(rpy(moved) - rpy(z[3:]))[::-1]])
    assert error @ full @ error == pytest.approx(np.sum((isam_root @ change) ** 2), rel=1e-5)


def test_isam_edge3_without_a_weight_has_the_identity(tmp_path: Path) -> None:
    edge = factors(read_text(tmp_path, "EDGE3 0 1 1 2 3 0 0 0\n", "a.txt"), "between_se3")
    full = np.diag([1, 1, 1, 4, 4, 4.0])
    np.testing.assert_allclose(edge.information[0], full[np.triu_indices(6)], atol=1e-15)


@pytest.mark.parametrize(
    ("text", "name", "dialect"),
    [
        ("EDGE2 0 1 1 0 0 1 0 1 1 0 0\n", "a.txt", "toro"),
        ("EDGE2 0 1 1 0 0 1 0 0 1 0 1\n", "a.txt", "isam"),
        ("EDGE2 0 1 1 0 0 9 1 9 9 1 1\n", "a.graph", "toro"),
        ("EDGE2 0 1 1 0 0 9 1 1 9 1 9\n", "a.txt", "isam"),
        ("EDGE2 0 1 1 0 0 1 0 1 1 0 0.000\nVERTEX2 0 0 0 0\n", "a.dat", "toro"),
        ("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n", "a.txt", "g2o"),
        ("LANDMARK 0 1 1 0 1 0 1\n", "a.g2o", "isam"),
    ],
)
def test_dialect_is_known_by_its_records(tmp_path: Path, text: str, name: str, dialect: str) -> None:
    assert read_text(tmp_path, text, name).dialect == dialect


def test_dialect_can_be_said(tmp_path: Path) -> None:
    graph = read_text(tmp_path, "EDGE2 0 1 1 0 0 9 1 9 9 1 1\n", "a.txt", "toro")
    np.testing.assert_array_equal(factors(graph, "between_se2").information, [[9, 1, 1, 9, 1, 9]])


def test_gzip_and_byte_order_mark(tmp_path: Path) -> None:
    text = f"\ufeffEDGE_SE2 0 1 1 0 0 {INFO3}\n".encode()
    path = tmp_path / "a.g2o.gz"
    path.write_bytes(gzip.compress(text))
    assert read(path).poses == 2


def test_points_and_poses_numbered_apart_as_gtsam_does(tmp_path: Path) -> None:
    graph = read_text(tmp_path, "VERTEX_SE2 0 0 0 0\nVERTEX_XY 0 1 1\nEDGE_SE2_XY 0 0 1 1 1 0 1\n")
    np.testing.assert_array_equal(factors(graph, "landmark_se2").keys, [[x(0)[0], points(0)[0]]])
    assert graph.notes == ("poses and points are numbered separately",)


def test_large_ids_stay_exact(tmp_path: Path) -> None:
    large = 2**56 - 1
    graph = read_text(tmp_path, f"EDGE_SE2 {large - 1} {large} 1 0 0 {INFO3}\n")
    np.testing.assert_array_equal(factors(graph, "between_se2").keys, [x(large - 1, large)])


def test_same_vertex_line_twice_is_one_vertex(tmp_path: Path) -> None:
    assert read_text(tmp_path, "VERTEX_SE2 0 1 2 3\nVERTEX_SE2 0 1 2 3\n").poses == 1
