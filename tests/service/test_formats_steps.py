"""The replay of a file: which step brings what, and what happens when the order of a file is not that of time."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.formats import FormatError, GraphFile, Steps, read
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import format_symbol

INFO3 = "1 0 0 1 0 1"


def edge(i: int, j: int, x: float = 1.0) -> str:
    return f"EDGE_SE2 {i} {j} {x} 0 0 {INFO3}\n"


def observation(i: int, l: int) -> str:
    return f"EDGE_SE2_XY {i} {l} 1 2 1 0 1\n"


def graph_of(folder: Path, text: str) -> GraphFile:
    path = folder / "a.g2o"
    path.write_text(text)
    return read(path)


def told(batch: Batch) -> tuple[list[str], list[str]]:
    """What a step brings, for people: (variables, factors in order)."""
    variables = [
        format_symbol(key) + ("!" if group.fixed else "") + ("" if group.values is None else "=")
        for group in batch.variables
        for key in group.keys.tolist()
    ]
    factors = ["-".join(format_symbol(key) for key in keys) for group in batch.factors for keys in group.keys.tolist()]
    return variables, factors


def story(steps: Steps) -> list[tuple[list[str], list[str]]]:
    return [told(step) for step in steps]


def test_a_step_is_a_pose_with_its_odometry_first(tmp_path: Path) -> None:
    text = (
        edge(0, 1)
        + edge(2, 0)
        + edge(1, 2)
        + edge(2, 3)
        + observation(3, 9)
        + edge(1, 3)
        + edge(2, 3, 5)
        + observation(1, 9)
    )
    assert story(graph_of(tmp_path, text).steps()) == [
        (["x0!="], []),
        (["x1", "l9"], ["x0-x1", "x1-l9"]),
        (["x2"], ["x1-x2", "x2-x0"]),
        (["x3"], ["x2-x3", "x1-x3", "x2-x3", "x3-l9"]),
    ]


def test_first_pose_is_fixed_at_its_vertex_or_at_the_origin(tmp_path: Path) -> None:
    first = graph_of(tmp_path, edge(0, 1)).steps()[0].variables[0]
    assert first.fixed
    np.testing.assert_array_equal(first.values, [[0, 0, 0]])
    first = graph_of(tmp_path, "VERTEX_SE2 0 1 2 3\nVERTEX_SE2 1 4 5 6\n" + edge(0, 1)).steps()[0].variables[0]
    assert first.fixed
    np.testing.assert_array_equal(first.values, [[1, 2, 3]])
    info = " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
    first = graph_of(tmp_path, f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {info}\n").steps()[0].variables[0]
    np.testing.assert_array_equal(first.values, [[0, 0, 0, 0, 0, 0, 1]])


def test_values_of_the_file_are_used_when_asked_for(tmp_path: Path) -> None:
    graph = graph_of(tmp_path, "VERTEX_SE2 0 1 2 3\nVERTEX_SE2 1 4 5 6\n" + edge(0, 1) + edge(1, 2))
    assert [names for names, _ in story(graph.steps(use_values=True))] == [["x0!="], ["x1="], ["x2"]]
    assert [names for names, _ in story(graph.steps())] == [["x0!="], ["x1"], ["x2"]]
    np.testing.assert_array_equal(graph.steps(use_values=True)[1].variables[0].values, [[4, 5, 6]])


def test_fix_lines_take_the_place_of_the_first_pose(tmp_path: Path) -> None:
    text = "VERTEX_SE2 1 1 2 3\nFIX 1\n" + edge(0, 1) + edge(1, 2)
    assert story(graph_of(tmp_path, text).steps()) == [(["x1!=", "x0"], ["x0-x1"]), (["x2"], ["x1-x2"])]
    assert story(graph_of(tmp_path, "FIX 0\n" + edge(0, 1)).steps()) == [(["x0!="], []), (["x1"], ["x0-x1"])]


def test_a_prior_takes_the_place_of_the_first_pose(tmp_path: Path) -> None:
    text = f"EDGE_PRIOR_SE2 0 1 2 3 {INFO3}\n" + edge(0, 1)
    assert story(graph_of(tmp_path, text).steps()) == [(["x0"], ["x0"]), (["x1"], ["x0-x1"])]


def test_a_pose_waits_for_the_one_that_joins_it(tmp_path: Path) -> None:
    text = edge(1, 2) + observation(1, 8) + edge(2, 3) + edge(0, 3) + edge(3, 4)
    assert story(graph_of(tmp_path, text).steps()) == [
        (["x0!="], []),
        (["x1", "x2", "x3", "l8"], ["x1-x2", "x2-x3", "x0-x3", "x1-l8"]),
        (["x4"], ["x3-x4"]),
    ]


def test_a_pose_joined_by_points_alone_takes_its_value(tmp_path: Path) -> None:
    text = edge(0, 1) + observation(0, 8) + observation(2, 8) + edge(2, 3)
    with pytest.raises(
        FormatError, match=r"x2 is joined to the rest only through points; wanted .* a vertex line for x2"
    ):
        graph_of(tmp_path, text).steps()
    assert story(graph_of(tmp_path, "VERTEX_SE2 2 5 5 5\n" + text).steps()) == [
        (["x0!=", "l8"], ["x0-l8"]),
        (["x1"], ["x0-x1"]),
        (["x2="], ["x2-l8"]),
        (["x3"], ["x2-x3"]),
    ]


def test_localization_among_fixed_points(tmp_path: Path) -> None:
    text = "VERTEX_SE2 0 1 1 1\nVERTEX_XY 8 1 2\nFIX 8\n" + observation(0, 8) + edge(0, 1) + observation(1, 8)
    assert story(graph_of(tmp_path, text).steps()) == [
        (["x0=", "l8!="], ["x0-l8"]),
        (["x1"], ["x0-x1", "x1-l8"]),
    ]


def test_parts_are_named(tmp_path: Path) -> None:
    text = edge(0, 1) + edge(1, 2) + edge(5, 6) + observation(6, 9) + "VERTEX_XY 11 0 0\n"
    with pytest.raises(FormatError, match=r"2 parts .*: x0 .. x2 \(3 variables\); x5 .. l9 \(3 variables\); wanted"):
        graph_of(tmp_path, text).steps()
    fixed = "VERTEX_SE2 5 9 9 9\nFIX 0\nFIX 5\n" + edge(0, 1) + edge(5, 6)
    assert [names for names, _ in story(graph_of(tmp_path, fixed).steps())] == [["x0!="], ["x1"], ["x5!="], ["x6"]]


def test_fixed_without_value(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="x1 is fixed but has no value"):
        graph_of(tmp_path, "FIX 1\n" + edge(0, 1)).steps()


def test_no_pose(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="no pose"):
        graph_of(tmp_path, "VERTEX_XY 0 1 1\n").steps()


def test_steps_are_a_sequence(tmp_path: Path) -> None:
    steps = graph_of(tmp_path, edge(0, 1) + edge(1, 2)).steps()
    assert len(steps) == 3
    assert told(steps[-1]) == told(steps[2])
    assert [told(step) for step in steps[1:]] == story(steps)[1:]
    with pytest.raises(IndexError, match="step 3 of 3"):
        steps[3]


def test_whole_is_all_steps_at_once(tmp_path: Path) -> None:
    graph = graph_of(tmp_path, "VERTEX_SE2 1 7 7 7\n" + edge(0, 1) + edge(1, 2) + observation(2, 9))
    assert told(graph.whole()) == (["x0!=", "x1=", "x2", "l9"], ["x0-x1", "x1-x2", "x2-l9"])


@st.composite
def drives(draw: st.DrawFn) -> tuple[list[str], int]:
    """Lines of a file in time order: odometry, loop closures in both directions, points; and the number of poses."""
    poses = draw(st.integers(2, 9))
    lines = []
    for j in range(1, poses):
        lines.append(edge(j - 1, j) if draw(st.booleans()) else edge(j, j - 1))
        loops = draw(st.lists(st.integers(0, j - 1), max_size=3))
        lines += [edge(i, j, 2.0) if draw(st.booleans()) else edge(j, i, 2.0) for i in loops]
        lines += [observation(j, 100 + point) for point in draw(st.lists(st.integers(0, 3), max_size=2))]
    return lines, poses


@given(drive=drives(), order=st.randoms(use_true_random=False))
def test_any_order_of_lines_is_replayed_in_time(
    tmp_path_factory: pytest.TempPathFactory, drive: tuple[list[str], int], order
) -> None:
    lines, poses = drive
    folder = tmp_path_factory.mktemp("drive")
    straight = graph_of(folder, "".join(lines))
    steps = straight.steps()
    assert len(steps) == poses
    written = next(group for group in straight.batch.factors if group.kind == "between_se2")
    replayed = np.concatenate([group.keys for step in steps for group in step.factors if group.kind == "between_se2"])
    np.testing.assert_array_equal(replayed, written.keys)  # already in time order: nothing moves

    order.shuffle(lines)
    known: set[int] = set()
    factors = 0
    for step in graph_of(folder, "".join(lines)).steps():
        new = {key for group in step.variables for key in group.keys.tolist()}
        assert not new & known
        assert sum(format_symbol(key)[0] == "x" for key in new) == 1
        known |= new
        for group in step.factors:
            factors += len(group.keys)
            assert all(
                known.issuperset(keys) and new & set(keys)
                for keys in group.keys.tolist()
                if group.kind == "between_se2"
            )
            assert known.issuperset(group.keys.ravel().tolist())
    assert factors == len(lines)


@given(
    pairs=st.lists(
        st.tuples(st.integers(0, 7), st.integers(0, 7)).filter(lambda p: p[0] != p[1]), min_size=1, max_size=14
    )
)
def test_every_edge_comes_when_both_poses_can_be_composed(
    tmp_path_factory: pytest.TempPathFactory, pairs: list[tuple[int, int]]
) -> None:
    """Any graph at all: either it is in parts and refused, or every step can be composed from what came before."""
    graph = graph_of(tmp_path_factory.mktemp("any"), "".join(edge(i, j) for i, j in pairs))
    names = sorted({name for pair in pairs for name in pair})
    reached = {names[0]}
    while grown := {name for pair in pairs if set(pair) & reached for name in pair} - reached:
        reached |= grown
    if reached != set(names):
        with pytest.raises(FormatError, match="parts that no factor joins"):
            graph.steps()
        return
    known: set[int] = set()
    for step in graph.steps():
        new = {key for group in step.variables for key in group.keys.tolist()}
        composed = known | {key for group in step.variables if group.fixed for key in group.keys.tolist()}
        ends = [set(keys) for group in step.factors for keys in group.keys.tolist()]
        while more := {key for pair in ends if pair & composed for key in pair} - composed:
            composed |= more
        assert composed == known | new
        known = composed
    assert len(known) == len(names)
