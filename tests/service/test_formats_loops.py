"""A trajectory and a list of loop closures become a graph."""

import math
from pathlib import Path

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.formats import FormatError, read, with_loops, write_graph
from factorbus.formats.rotations import compose_poses

HALF = math.sin(math.pi / 4)
# A square of 2 m whose third side is too long: the robot, which was where it began, says that it is 1 m off.
WAY = ["0 0 0 0 0 0 0 1", "1 2 0 0 0 0 {h} {h}", "2 2 2 0 0 0 1 0", "3 -1 2 0 0 0 -{h} {h}", "4 -1 0 0 0 0 0 1"]


@pytest.fixture
def way(tmp_path: Path) -> Path:
    (tmp_path / "way.tum").write_text("\n".join(each.format(h=HALF) for each in WAY) + "\n")
    return tmp_path / "way.tum"


def loops(way: Path, text: str) -> Path:
    path = way.with_name("loops.txt")
    path.write_text(text)
    return path


@pytest.mark.parametrize("ends", ["0 4", "0.0 4.0", "0 4.0000009"])
def test_it_is_the_graph_of_the_same_draft(way: Path, ends: str) -> None:
    graph = with_loops(read(way), loops(way, f"# seen again\n{ends} 0 0 0 0 0 0 1 0.1 0.01  # by hand\n"))
    (group,), (found,) = graph.batch.variables, graph.batch.factors
    assert group.values is not None
    draft = Draft()
    for n, pose in enumerate(group.values):
        draft.se3(f"x{n}", pose)
    for n in range(4):
        steps = compose_poses(found.measured[n : n + 1], np.array([[0.0, 0, 0, 0, 0, 0, 1]]))[0]
        metres = max(0.001, 0.02 * np.linalg.norm(steps[:3]))
        turned = math.pi / 2
        radians = 0.01 * np.linalg.norm(steps[:3]) + 0.02 * turned
        draft.between_se3(f"x{n}", f"x{n + 1}", steps, sigmas=[metres] * 3 + [radians] * 3)
    draft.between_se3("x0", "x4", (0, 0, 0, 0, 0, 0, 1), sigmas=[0.1] * 3 + [0.01] * 3)
    (wanted,) = draft.batch().factors
    np.testing.assert_array_equal(found.keys, wanted.keys)
    np.testing.assert_allclose(found.measured, wanted.measured, atol=1e-12)
    np.testing.assert_allclose(found.information, wanted.information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.measured[2, :3], [3, 0, 0], atol=1e-12)  # in its own frame


def test_it_can_be_written_and_driven(way: Path, tmp_path: Path) -> None:
    graph = with_loops(read(way), loops(way, "0 4 0 0 0 0 0 0 1\n"))
    assert "1 loop closure of" in graph.notes[-1]
    assert "0.05 m and 0.02 rad" in graph.notes[-1]
    write_graph(tmp_path / "way.g2o", graph.batch)
    again = read(tmp_path / "way.g2o")
    assert (again.poses, again.batch.factor_count) == (5, 5)
    assert len(list(again.steps())) == len(list(graph.steps())) == 5


@pytest.mark.parametrize(
    ("text", "wanted", "line"),
    [
        ("", "no loop closure", None),
        ("0 4 0 0 0 0 0 0\n", "wanted first second", 1),
        ("0 4 0 0 0 0 0 0 1 0.1\n", "wanted first second", 1),
        ("0 4 0 0 0 0 0 x 1\n", "wanted first second", 1),
        ("0 4 0 0 0 0 0 0 1\n0 5 0 0 0 0 0 0 1\n", "pose 5; wanted a place from 0 to 4", 2),
        ("0 4 0 0 0 0 0 0 1\n0 3.5 0 0 0 0 0 0 1\n", "pose 3.5; wanted a place from 0 to 4", 2),
        ("2 2 0 0 0 0 0 0 1\n", "a pose and itself", 1),
        ("0 4 0 0 0 0 0 0 2\n", "a quaternion of norm 2", 1),
        ("0 4 0 0 0 0 0 0 1 0 0.1\n", "more than 0", 1),
        ("0 4 1e999 0 0 0 0 0 1\n", "not finite", 1),
    ],
)
def test_what_is_no_closure_is_refused(way: Path, text: str, wanted: str, line: int | None) -> None:
    with pytest.raises(FormatError, match=wanted) as refused:
        with_loops(read(way), loops(way, text))
    assert refused.value.line == line


def test_the_place_that_there_is_not_is_named_and_not_the_first_that_is_no_time(tmp_path: Path) -> None:
    (tmp_path / "late.tum").write_text("1700000000.5 0 0 0 0 0 0 1\n1700000001.5 1 0 0 0 0 0 1\n")
    graph = read(tmp_path / "late.tum")
    with pytest.raises(FormatError, match="pose 99; wanted a place from 0 to 1, or within") as refused:
        with_loops(graph, loops(tmp_path / "late.tum", "0 1 0 0 0 0 0 0 1\n0 99 0 0 0 0 0 0 1\n"))
    assert refused.value.line == 2
    with pytest.raises(FormatError, match=r"cannot be read .*; wanted lines of first second tx"):
        with_loops(graph, tmp_path / "none.txt")


def test_a_graph_takes_no_list(way: Path, tmp_path: Path) -> None:
    (tmp_path / "a.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    with pytest.raises(FormatError, match="wanted a trajectory"):
        with_loops(read(tmp_path / "a.g2o"), loops(way, "0 1 0 0 0 0 0 0 1\n"))
