"""PyFactorGraph's text: every record as it is read, what is refused, and the same graph after writing and reading."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from factorbus.formats import FormatError, GraphFile, as_pyfg, read, write_pyfg
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol

A0, A1, B0, L0, L1 = (symbol(letter, index) for letter, index in (("A", 0), ("A", 1), ("B", 0), ("L", 0), ("L", 1)))
PLANE = """\
VERTEX_SE2 1.5 A0 0 0 0
VERTEX_SE2 1403636579.763555584 A1 1 0 0.5
VERTEX_SE2 2 B0 5 5 1
VERTEX_XY L0 3 4
VERTEX_XY L1 0 2
VERTEX_SE2:PRIOR 1.5 A0 0 0 0 0.01 0 0 0.01 0 0.04
VERTEX_XY:PRIOR 0 L0 3 4 0.25 0.1 0.5
EDGE_SE2 1.5 A0 A1 1 0 0.5 0.01 0.002 0 0.04 0 0.0025
EDGE_SE2_XY 1.5 A0 L1 0 2 0.25 0 0.5
EDGE_RANGE 1.5 A0 L0 5.5 0.25
EDGE_RANGE 2 L0 B0 2.5 0.0625
EDGE_RANGE 2 A1 B0 6.5 0.16
"""
COVARIANCE6 = "0.01 0 0 0 0 0.0005 0.04 0 0 0 0 0.09 0 0 0 0.0004 0 0 0.0025 0 0.0001"
SPACE = f"""\
VERTEX_SE3:QUAT 0.0 A0 0 0 0 0 0 0 1
VERTEX_SE3:QUAT 0.0 A1 1 0 0 0 0 0.6 0.8
VERTEX_XYZ L0 1 2 3
VERTEX_SE3:QUAT:PRIOR 0.0 A0 0 0 0 0 0 0 1 {COVARIANCE6}
VERTEX_XYZ:PRIOR 0.0 L0 1 2 3 1 0 0 1 0 1
EDGE_SE3:QUAT 0.0 A0 A1 1 0 0 0 0 0.6 0.8 {COVARIANCE6}
EDGE_SE3_XYZ 0.0 A0 L0 1 2 3 0.25 0 0 1 0 1
EDGE_RANGE 0.0 A1 L0 3.5 0.25
EDGE_RANGE 0.0 A1 A0 1.25 0.25
"""


def read_text(folder: Path, text: str, name: str = "a.pyfg", strict: bool = False) -> GraphFile:
    (folder / name).write_text(text)
    return read(folder / name, strict=strict)


def factors(graph: GraphFile, kind: str) -> Factors:
    return next(group for group in graph.batch.factors if group.kind == kind)


def test_the_plane(tmp_path: Path) -> None:
    graph = read_text(tmp_path, PLANE, strict=True)
    assert (graph.dialect, graph.poses, graph.landmarks, graph.notes) == ("pyfg", 3, 2, ())
    poses, points = graph.batch.variables
    assert poses.keys.tolist() == [A0, A1, B0]
    assert poses.stamps is not None
    assert poses.stamps.tolist() == [1500000000, 1403636579763555584, 2000000000]
    assert points.keys.tolist() == [L0, L1]
    assert points.stamps is None
    between = factors(graph, "between_se2")
    covariance = np.array([[0.01, 0.002, 0], [0.002, 0.04, 0], [0, 0, 0.0025]])
    np.testing.assert_allclose(between.information[0], np.linalg.inv(covariance)[np.triu_indices(3)], rtol=1e-13)
    range_se2, range_between = factors(graph, "range_se2"), factors(graph, "range_between_se2")
    assert range_se2.keys.tolist() == [[A0, L0], [B0, L0]], "the pose comes first"
    assert range_se2.information.tolist() == [[4.0], [16.0]]
    assert (range_between.keys.tolist(), range_between.measured.tolist()) == ([[A1, B0]], [[6.5]])
    assert {group.kind for group in graph.batch.factors} >= {"prior_se2", "prior_point2", "landmark_se2"}


def test_space_has_radians_and_a_file_without_times_has_no_stamps(tmp_path: Path) -> None:
    graph = read_text(tmp_path, SPACE, strict=True)
    assert all(group.stamps is None for group in graph.batch.variables)
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = np.array(COVARIANCE6.split(), float)
    to_half_angles = np.diag([1, 1, 1, 0.5, 0.5, 0.5])
    covariance = to_half_angles @ (upper + np.triu(upper, 1).T) @ to_half_angles
    for kind in ("between_se3", "prior_se3"):
        found = factors(graph, kind).information[0]
        np.testing.assert_allclose(found, np.linalg.inv(covariance)[np.triu_indices(6)], rtol=1e-12, atol=1e-9)
    assert factors(graph, "landmark_se3").information[0].tolist() == [4, 0, 0, 1, 0, 1]
    assert factors(graph, "range_se3").keys.tolist() == [[A1, L0]]
    assert factors(graph, "range_between_se3").keys.tolist() == [[A1, A0]]


@pytest.mark.parametrize("text", [PLANE, SPACE], ids=["plane", "space"])
def test_it_is_known_by_its_ending_or_its_names(tmp_path: Path, text: str) -> None:
    assert read_text(tmp_path, text, "a.txt").dialect == "pyfg"
    assert read_text(tmp_path, "VERTEX_SE2 0 A0 0 0 0\n", "a.g2o").dialect == "pyfg"
    assert read_text(tmp_path, "VERTEX_SE2 0 0 0 0 0\n", "a.PYFG").batch.variables[0].keys.tolist() == [0]
    assert read_text(tmp_path, "VERTEX_SE2 0 0 0 0\n", "a.g2o").dialect == "g2o"


REFUSED = {
    "fields": ("VERTEX_SE2 0 A0 0 0\n", 1, "VERTEX_SE2 with 4 fields; wanted 5: time, name and 3 numbers"),
    "name": (PLANE.replace("XY L1 0 2", "XY L_1 0 2"), 5, "VERTEX_XY of 'L_1'; wanted a letter and a number"),
    "time": (PLANE.replace("SE2 2 B0", "SE2 soon B0"), 3, "a time of 'soon'"),
    "number": (PLANE.replace("B0 5 5 1", "B0 5 x 1"), 3, "VERTEX_SE2 with 'x'"),
    "covariance": (PLANE.replace("5.5 0.25", "5.5 0"), 10, "EDGE_RANGE with a covariance matrix that is not positive"),
    "range": (PLANE.replace("5.5 0.25", "0 0.25"), 10, "EDGE_RANGE of 0; wanted a distance above 0"),
    "itself": (PLANE.replace("A1 B0 6.5", "B0 B0 6.5"), 12, "EDGE_RANGE from B0 to itself"),
    "unknown": (PLANE.replace("A0 L0 5.5", "A0 L7 5.5"), 10, "EDGE_RANGE of L7, of which no other line tells"),
    "spaces": (PLANE + "VERTEX_XYZ L9 1 2 3\nEDGE_RANGE 0 A0 L9 1 1\n", 14, "EDGE_RANGE between se2 and point3"),
    "kinds": (PLANE + "VERTEX_XY A0 1 2\n", 13, "as a 2D point"),
    "times": (PLANE + "VERTEX_SE2 1.75 A0 0 0 0\n", 13, "A0 again, at another time"),
    "quaternion": (SPACE.replace("L0 1 2 3\n", "L0 1 2 3\nVERTEX_SE3:QUAT 0 A3 0 0 0 0 0 0 2\n", 1), 4, "norm 2"),
    "nothing": ("VERTEX_FISH 7\n", None, "no pyfg record"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_broken_is_refused_with_its_line(tmp_path: Path, case: str) -> None:
    text, line, said = REFUSED[case]
    with pytest.raises(FormatError) as caught:
        read_text(tmp_path, text)
    assert said in str(caught.value)
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("text", "name"),
    [
        (PLANE + "EDGE_SE2 0 A1 A9 1 0 0 1 0 0 1 0 1\n", "A9"),
        (PLANE.replace("VERTEX_XY L1 0 2\n", ""), "L1"),
        (PLANE.replace("PRIOR 0 L0", "PRIOR 0 L9"), "L9"),
    ],
)
def test_a_name_without_a_vertex_is_said(tmp_path: Path, text: str, name: str) -> None:
    """It may be misspelt."""
    assert f"1 name without a vertex line, each a variable: {name}" in read_text(tmp_path, text).notes
    assert not any("vertex line" in note for note in read_text(tmp_path, PLANE).notes)


LEFT_OUT = {
    "EDGE_RANGE": ("EDGE_RANGE 0 L0 L1 4 0.25\n", "a distance between two points"),
    "EDGE_FISH": ("EDGE_FISH 0 A0 A1\n", "no pyfg record that is read"),
    "EDGE_SE2 times": ("EDGE_SE2 7 A0 A1 1 0 0.5 1 0 0 1 0 1\n", "no time other than that of its poses"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_has_no_kind_is_left_out_and_said(tmp_path: Path, name: str) -> None:
    more, why = LEFT_OUT[name]
    graph = read_text(tmp_path, PLANE + more)
    assert graph.left_out == {name: 1}
    assert why in graph.notes[0]
    with pytest.raises(FormatError, match="strict"):
        read_text(tmp_path, PLANE + more, strict=True)


def assert_same(one: Batch, other: Batch) -> None:
    """Keys, values, measurements and stamps to the bit; information to the digits that two inversions keep."""
    assert [(v.kind, v.keys.tolist()) for v in one.variables] == [(v.kind, v.keys.tolist()) for v in other.variables]
    assert [(f.kind, f.keys.tolist()) for f in one.factors] == [(f.kind, f.keys.tolist()) for f in other.factors]
    for v, w in zip(one.variables, other.variables, strict=True):
        np.testing.assert_array_equal(np.array(v.values), np.array(w.values))
        np.testing.assert_array_equal(np.array(v.stamps), np.array(w.stamps))
    for f, g in zip(one.factors, other.factors, strict=True):
        np.testing.assert_array_equal(f.measured, g.measured)
        scale = np.abs(f.information).max(axis=1, keepdims=True)
        np.testing.assert_allclose(f.information / scale, g.information / scale, atol=1e-11)


@pytest.mark.parametrize("text", [PLANE, SPACE], ids=["plane", "space"])
def test_what_is_read_is_written_and_read_again(tmp_path: Path, text: str) -> None:
    graph = read_text(tmp_path, text)
    assert write_pyfg(tmp_path / "b.pyfg", graph.batch, strict=True) == ()
    assert_same(graph.batch, read(tmp_path / "b.pyfg", strict=True).batch)


KINDS = (
    "prior_se2", "prior_se3", "prior_point2", "prior_point3", "between_se2", "between_se3", "landmark_se2",
    "landmark_se3", "range_se2", "range_se3", "range_between_se2", "range_between_se3",
)  # fmt: skip
LETTERS = {"se2": "A", "se3": "B", "point2": "L", "point3": "M"}


def random_graph(seed: int, kinds: set[str], stamped: bool) -> Batch:
    """Three variables of each kind, all with values, and two factors of each of `kinds`."""
    rng = np.random.default_rng(seed)

    def pose(size: int) -> np.ndarray:
        row = 3 * rng.normal(size=size)
        if size == 7:
            row[3:] /= np.linalg.norm(row[3:])
        return row

    first = {kind: symbol(letter, int(rng.integers(1000))) for kind, letter in LETTERS.items()}
    variables = []
    for kind, key in first.items():
        values = np.array([pose(VARIABLE_KINDS[kind].size) for _ in range(3)])
        stamps = rng.integers(1, 2**62, 3) if stamped and VARIABLE_KINDS[kind].is_pose else None
        variables.append(Variables(kind, key + np.arange(3), values, False, stamps))
    groups = []
    for name in (name for name in FACTOR_KINDS if name in kinds):
        kind = FACTOR_KINDS[name]
        rows = [rng.permutation(3)[: len(kind.connects)] for _ in range(2)]
        keys = np.array([[first[end] + row[k] for k, end in enumerate(kind.connects)] for row in rows])
        z = np.array([pose(kind.size) for _ in rows])
        roots = [rng.normal(size=(kind.dim, kind.dim)) + 2 * np.eye(kind.dim) for _ in rows]
        packed = np.array([(root.T @ root + 0.1 * np.eye(kind.dim))[np.triu_indices(kind.dim)] for root in roots])
        if name.startswith("range"):
            z = np.array(np.abs(z) + 0.1, np.float64)
        groups.append(Factors(name, keys, z, packed))
    return Batch(tuple(variables), tuple(groups))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), kinds=st.sets(st.sampled_from(KINDS), min_size=1), stamped=st.booleans())
def test_any_graph_of_these_kinds_is_the_same_after_writing_and_reading(
    tmp_path: Path, seed: int, kinds: set[str], stamped: bool
) -> None:
    batch = random_graph(seed, kinds, stamped)
    assert write_pyfg(tmp_path / "a.pyfg", batch, strict=True) == ()
    again = read(tmp_path / "a.pyfg", strict=True, whole=True).batch
    assert_same(batch, again)


def test_what_pyfg_has_no_record_for_is_left_out_and_said() -> None:
    poses = Variables("se2", np.array([A0, A1]), np.zeros((2, 3)), True, np.array([5, NO_STAMP]))
    points = Variables("point2", np.array([L0]), np.zeros((1, 2)), False, np.array([7]))
    bearing = Factors("bearing_se2", np.array([[A0, L0]]), np.ones((1, 1)), np.ones((1, 1)))
    far = Factors("range_se2", np.array([[A0, L0]]), np.ones((1, 1)), np.ones((1, 1)), "huber", np.ones(1))
    written = as_pyfg(Batch((points, poses), (bearing, far)))
    assert written.left_out == {"time stamps": 1, "fixed variables": 2, "bearing_se2": 1, "range_se2 loss": 1}
    assert "1 pose without a time stamp: written with the time 0" in written.notes
    assert written.text.splitlines() == [
        "VERTEX_SE2 0.000000005 A0 0 0 0",
        "VERTEX_SE2 0.000000000 A1 0 0 0",
        "VERTEX_XY L0 0 0",
        "EDGE_RANGE 0.000000005 A0 L0 1 1",
    ]
    at_zero = as_pyfg(Batch((poses._replace(fixed=False, stamps=np.zeros(2, np.int64)),)))
    assert at_zero.left_out == {"time stamps": 2}
