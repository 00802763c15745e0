"""Replays in which ranges tell where points and robots are: when these enter, and that the solver takes every step."""

from pathlib import Path

import numpy as np
import pytest

from factorbus.formats import FormatError, GraphFile, read
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import format_symbol
from factorbus.solver import Options, Solver

STEP = "1e-4 0 0 1e-4 0 1e-6"
STEP3 = "1e-4 0 0 0 0 0 1e-4 0 0 0 0 1e-4 0 0 0 1e-6 0 0 1e-6 0 1e-6"


def read_text(folder: Path, lines: list[str], strict: bool = False) -> GraphFile:
    (folder / "a.pyfg").write_text("\n".join(lines) + "\n")
    return read(folder / "a.pyfg", strict=strict)


def entries(graph: GraphFile, use_values: bool = False) -> dict[str, int]:
    """The step in which each variable comes."""
    return {
        format_symbol(key): k
        for k, step in enumerate(graph.steps(use_values))
        for group in step.variables
        for key in group.keys.tolist()
    }


def solved(steps: list[Batch] | GraphFile) -> Solver:
    """After all steps, each taken."""
    solver = Solver(Options())
    for step in steps.steps() if isinstance(steps, GraphFile) else steps:
        solver.stage(step)
        solver.step()
    return solver


def drive(robot: str, places: np.ndarray, times: bool = False, first: int = 0) -> list[str]:
    """A robot that looks along x at `places` (n, 2), from the time `first` on every other second."""
    time = [float(first + 2 * k) if times else 0.0 for k in range(len(places))]
    lines = [f"VERTEX_SE2 {t} {robot}{k} {x} {y} 0" for k, (t, (x, y)) in enumerate(zip(time, places, strict=True))]
    moves = np.diff(places, axis=0)
    lines += [f"EDGE_SE2 {time[k]} {robot}{k} {robot}{k + 1} {x} {y} 0 {STEP}" for k, (x, y) in enumerate(moves)]
    return lines


def ranges(one: str, places: np.ndarray, other: str, to: np.ndarray) -> list[str]:
    """Ranges from each of a robot's poses to a point, or to the pose of the same number."""
    to = np.broadcast_to(to, places.shape)
    named = [other] * len(places) if other[-1].isdigit() else [f"{other}{k}" for k in range(len(places))]
    far = np.linalg.norm(places - to, axis=1)
    return [f"EDGE_RANGE 0 {one}{k} {name} {z} 0.01" for k, (name, z) in enumerate(zip(named, far, strict=True))]


BEND = np.array([[0, 0], [1, 0], [2, 0], [2, 1], [2, 2], [2, 3.0]])
ANCHOR = np.array([6.0, 0.0])


def test_a_point_waits_until_ranges_determine_it_and_enters_at_its_value(tmp_path: Path) -> None:
    lines = [*drive("A", BEND), "VERTEX_XY L0 6.3 0.2", *ranges("A", BEND, "L0", ANCHOR)]
    graph = read_text(tmp_path, lines, strict=True)
    assert entries(graph) == {**{f"A{k}": k for k in range(6)}, "L0": 3}, "first three poses are in line with it"
    step = graph.steps()[3]
    point = next(group for group in step.variables if group.kind == "point2")
    assert point.values is not None
    assert point.values.tolist() == [[6.3, 0.2]]
    assert next(len(group.keys) for group in step.factors if group.kind == "range_se2") == 4, "its ranges waited too"
    solver = solved(graph)
    assert solver.chi2() == pytest.approx(0.0, abs=1e-6)
    point = next(group for group in solver.estimate() if group.kind == "point2")
    np.testing.assert_allclose(point.values[0], ANCHOR, atol=1e-3)


def test_a_point_in_space_needs_three_ranges_that_are_not_in_one_plane(tmp_path: Path) -> None:
    places = np.array([[0, 0, 0], [1, 0, 0], [2, 1, 0], [2, 1, 2.0], [2, 3, 2]])
    lines = [f"VERTEX_SE3:QUAT 0 A{k} {x} {y} {z} 0 0 0 1" for k, (x, y, z) in enumerate(places)]
    moves = enumerate(np.diff(places, axis=0))
    lines += [f"EDGE_SE3:QUAT 0 A{k} A{k + 1} {x} {y} {z} 0 0 0 1 {STEP3}" for k, (x, y, z) in moves]
    lines += ["VERTEX_XYZ L0 4 4 0", *ranges("A", places, "L0", np.array([4.0, 4.0, 0.0]))]
    graph = read_text(tmp_path, lines, strict=True)
    assert entries(graph)["L0"] == 3
    assert solved(graph).chi2() == pytest.approx(0.0, abs=1e-6)


def test_too_few_ranges_leave_a_point_out_of_the_replay_and_in_the_graph(tmp_path: Path) -> None:
    lines = [*drive("A", BEND), "VERTEX_XY L0 6 0", "VERTEX_XY L1 6 1", "EDGE_RANGE 0 A0 L0 6 1"]
    graph = read_text(tmp_path, lines)
    assert graph.left_out == {"vertices": 1, "points": 1}
    assert graph.notes[1] == "1 point that replay and solve leave out: so few ranges do not place L0"
    assert graph.landmarks == 2
    assert set(entries(graph)) == {f"A{k}" for k in range(6)}
    assert solved(graph).variable_count == 6


def test_a_point_that_only_ranges_see_needs_a_value(tmp_path: Path) -> None:
    far = ["VERTEX_XY:PRIOR 0 L0 6 0 1 0 1"]
    lines = [*drive("A", BEND), *ranges("A", BEND, "L0", ANCHOR)]
    assert entries(read_text(tmp_path, [*lines, *far]))["L0"] == 0, "a prior is a value"
    seen = "EDGE_SE2_XY 0 A2 L0 4 0 1 0 1"
    graph = read_text(tmp_path, [*lines, seen])
    assert entries(graph)["L0"] == 2, "its ranges wait for what places it"
    assert solved(graph).factor_count == 5 + 6 + 1
    kept = read_text(tmp_path, [line for line in lines if "A1 L0" not in line] + ["VERTEX_XY L0 6 0"])
    batch = kept.batch
    bare = tuple(v._replace(values=None) if v.kind == "point2" else v for v in batch.variables)
    with pytest.raises(FormatError, match="L0 is seen by ranges alone and has no value; wanted a vertex line for L0"):
        GraphFile(kept.path, "pyfg", Batch(bare, batch.factors), kept.factor_lines).steps()


B_PLACES = BEND[:, ::-1] + np.array([1.0, 3.0])


def test_a_robot_that_only_ranges_join_to_the_other_waits_until_they_determine_where_it_is(tmp_path: Path) -> None:
    lines = [*drive("A", BEND), *drive("B", B_PLACES), *ranges("A", BEND, "B", B_PLACES)]
    graph = read_text(tmp_path, lines, strict=True)
    found = entries(graph)
    assert [found[f"A{k}"] for k in range(6)] == list(range(6))
    together = [found[f"B{k}"] for k in range(6)].count(6)
    assert together >= 3, "with one or two ranges it may turn about the other"
    assert [found[f"B{k}"] for k in range(6)] == [6] * together + list(range(7, 13 - together))
    given = [group for step in graph.steps() for group in step.variables if group.values is not None]
    assert [format_symbol(key) for group in given for key in group.keys.tolist()] == ["A0", f"B{together - 1}"]
    assert solved(graph).chi2() == pytest.approx(0.0, abs=1e-6)


def test_poses_with_time_stamps_come_in_the_order_of_time(tmp_path: Path) -> None:
    held = [f"VERTEX_SE2:PRIOR {t} {name} {x} {y} 0 {STEP}" for t, name, x, y in ((0.0, "A0", 0, 0), (1.0, "B0", 4, 3))]
    lines = [*drive("B", B_PLACES, True, 1), *drive("A", BEND, True), *held, *ranges("A", BEND, "B", B_PLACES)]
    graph = read_text(tmp_path, [line.replace("EDGE_RANGE 0 ", "EDGE_RANGE 0.0 ") for line in lines])
    assert list(entries(graph)) == [f"{robot}{k}" for k in range(6) for robot in "AB"]
    for k, step in enumerate(graph.steps()):
        between = [group.keys.tolist() for group in step.factors if group.kind == "between_se2"]
        assert len(between) == (1 if k > 1 else 0)
    assert all(group.stamps is not None for step in graph.steps() for group in step.variables)
    solved(graph)


def test_a_robot_that_nothing_determines_is_an_error_that_names_it(tmp_path: Path) -> None:
    lines = [*drive("A", BEND), *drive("B", B_PLACES), "EDGE_RANGE 0 A0 B0 3 0.01"]
    with pytest.raises(FormatError, match="B0 is joined to the rest only through ranges that do not determine"):
        read_text(tmp_path, lines).steps()
