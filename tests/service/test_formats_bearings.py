"""Points that only bearings see: when they enter a replay, and that no mode loses them."""

from pathlib import Path

import numpy as np
import pytest

from factorbus.formats import GraphFile, read
from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import format_symbol, symbol
from factorbus.solver import Options, Solver, solve_batch
from factorbus.solver.errors import Uninitialized
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.model import layout

INFO3 = "400 0 0 400 0 2500"


def graph_of(folder: Path, text: str) -> GraphFile:
    path = folder / "a.g2o"
    path.write_text(text)
    return read(path)


def straight(poses: int) -> str:
    """A drive along x, a metre a step."""
    return "".join(f"EDGE_SE2 {k} {k + 1} 1 0 0 {INFO3}\n" for k in range(poses - 1))


def bearing(pose: int, point: tuple[float, float], number: int, more: float = 0.0, information: float = 1e6) -> str:
    angle = np.arctan2(point[1], point[0] - pose) + more
    return f"EDGE_BEARING_SE2_XY {pose} {number} {angle} {information}\n"


def entries(graph: GraphFile) -> dict[str, int]:
    """With which step each point comes."""
    return {
        format_symbol(key): number
        for number, step in enumerate(graph.steps())
        for group in step.variables
        if group.kind == "point2"
        for key in group.keys.tolist()
    }


def test_a_point_waits_for_a_ray_that_meets_an_earlier_one(tmp_path: Path) -> None:
    """100 m off, 12 m to the side: 0.1 rad apart after eleven steps.  Abeam and near: at once."""
    text = straight(14) + "".join(bearing(k, (20.0, 20.0), 90) + bearing(k, (0.5, 1.0), 91) for k in range(14))
    graph = graph_of(tmp_path, text)
    angle = np.arctan2(20.0, 20.0)
    first = next(k for k in range(14) if np.arctan2(20.0, 20.0 - k) - angle >= 0.1)
    assert entries(graph) == {"l90": first, "l91": 1}
    step = graph.steps()[first]
    bearings = next(group for group in step.factors if group.kind == "bearing_se2")
    assert [key for key in bearings.keys[:, 1].tolist() if key == symbol("l", 90)] == [symbol("l", 90)] * (first + 1)


def test_uncertain_bearings_wait_longer(tmp_path: Path) -> None:
    """Six standard deviations of two bearings of 0.03 rad: 0.25 rad."""
    text = straight(14) + "".join(bearing(k, (20.0, 20.0), 90, information=0.03**-2) for k in range(14))
    angle = np.arctan2(20.0, 20.0)
    first = next(k for k in range(14) if np.arctan2(20.0, 20.0 - k) - angle >= 6 * 0.03 * np.sqrt(2))
    assert entries(graph_of(tmp_path, text)) == {"l90": first}


def test_rays_that_meet_behind_the_robot_do_not_place_a_point(tmp_path: Path) -> None:
    text = straight(4) + bearing(0, (1.0, 1.0), 90) + bearing(1, (1.0, 1.0), 90, more=-1.2) + bearing(3, (1.0, 1.0), 90)
    assert entries(graph_of(tmp_path, text)) == {"l90": 3}


def test_a_point_that_never_gets_so_far_enters_last(tmp_path: Path) -> None:
    text = straight(6) + "".join(bearing(k, (1000.0, 10.0), 90) for k in range(5))
    assert entries(graph_of(tmp_path, text)) == {"l90": 4}


def test_what_places_a_point_lets_it_in(tmp_path: Path) -> None:
    seen = "EDGE_SE2_XY 2 90 998 10 1 0 1\n"
    text = straight(6) + "".join(bearing(k, (1000.0, 10.0), 90) for k in range(6)) + seen
    assert entries(graph_of(tmp_path, text)) == {"l90": 2}
    assert entries(graph_of(tmp_path, text.replace(seen, "EDGE_PRIOR_XY 90 1000 10 1 0 1\n"))) == {"l90": 0}


def course(seed: int, poses: int = 60) -> str:
    """A drive among points that are only seen by their bearings, 0.02 rad, with the file's values from the truth."""
    rng = np.random.default_rng(seed)
    x = np.zeros((poses, 3))
    for k in range(1, poses):
        turn = x[k - 1, 2]
        x[k] = [*(x[k - 1, :2] + [np.cos(turn), np.sin(turn)]), turn + 0.05 + 0.1 * rng.normal()]
    points = rng.uniform(x[:, :2].min(axis=0) - 5, x[:, :2].max(axis=0) + 5, (20, 2))
    lines = [f"VERTEX_SE2 {k} {' '.join(map(str, pose))}" for k, pose in enumerate(x)]
    lines += [f"VERTEX_XY {1000 + k} {px} {py}" for k, (px, py) in enumerate(points)] + ["FIX 0"]
    for k in range(poses):
        turn = np.array([[np.cos(x[k, 2]), np.sin(x[k, 2])], [-np.sin(x[k, 2]), np.cos(x[k, 2])]])
        if k + 1 < poses:
            z = np.append(turn @ (x[k + 1, :2] - x[k, :2]), x[k + 1, 2] - x[k, 2])
            z += rng.normal(0, [0.05, 0.05, 0.02])
            lines.append(f"EDGE_SE2 {k} {k + 1} {' '.join(map(str, z))} {INFO3}")
        for number, point in enumerate(points):
            u = turn @ (point - x[k, :2])
            if np.hypot(*u) < 8.0:
                angle = np.arctan2(u[1], u[0]) + 0.02 * rng.normal()
                lines.append(f"EDGE_BEARING_SE2_XY {k} {1000 + number} {angle} 2500")
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
@pytest.mark.parametrize("seed", range(2))
def test_no_mode_loses_a_point(tmp_path: Path, mode: str, seed: int) -> None:
    """At every step points are where there can be some, and at the end the map is at the optimum of the true start."""
    graph = graph_of(tmp_path, course(seed))
    whole = graph.whole()
    best = solve_batch(whole.variables, whole.factors).chi2
    solver = Solver(Options(mode=mode))
    for step in graph.steps():
        solver.stage(step)
        solver.step()
        points = [np.abs(group.values).max() for group in solver.estimate() if group.kind == "point2"]
        assert max(points, default=0.0) < 150.0
    solver.step(settle=True)
    assert solver.chi2() == pytest.approx(best, rel=1e-6)


def sees(poses: np.ndarray, angles: np.ndarray) -> Batch:
    """A point without a value and bearings to it from fixed poses."""
    keys = symbol("x", 0) + np.arange(len(poses))
    ends = np.stack([keys, np.full(len(keys), symbol("l", 0))], axis=1)
    return Batch(
        (Variables("se2", keys, poses, True), Variables("point2", np.array([symbol("l", 0)]))),
        (Factors("bearing_se2", ends, angles[:, None], np.ones((len(keys), 1))),),
    )


def placed(batch: Batch, kind: str = "point2") -> np.ndarray:
    """Where the point is before any step."""
    graph, size = FactorGraph(), VARIABLE_KINDS[kind].size
    admit(graph, batch)
    behind = int(graph.counts[layout.VALUES])
    return graph.values[behind - size : behind]


def test_two_bearings_place_a_point_where_they_meet() -> None:
    batch = sees(np.array([[0, 0, 0], [4, 0, np.pi / 2]]), np.array([np.pi / 4, np.pi / 4]))
    np.testing.assert_allclose(placed(batch), [2, 2], atol=1e-12)


def test_nearly_parallel_bearings_place_a_point_in_front() -> None:
    batch = sees(np.array([[0, 0, 0], [0, 1, 0.0]]), np.array([0.0, 0.01]))
    np.testing.assert_allclose(placed(batch), [10 * np.cos(0.01), 1 + 10 * np.sin(0.01)], rtol=1e-12)


def test_bearings_in_space_place_a_point() -> None:
    turn = np.array([0, 0, np.sin(0.3), np.cos(0.3)])
    poses = np.array([[0, 0, 0, *turn], [0, 2, 1, 0, 0, 0, 1.0]])
    point = np.array([3.0, 1.0, -2.0])
    rotation = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    ways = np.array([rotation.T @ (point - poses[0, :3]), point - poses[1, :3]])
    keys, point_key = symbol("x", 0) + np.arange(2), np.array([symbol("l", 0)])
    ends = np.stack([keys, np.full(2, point_key[0])], axis=1)
    information = np.tile(np.eye(3)[np.triu_indices(3)], (2, 1))
    batch = Batch(
        (Variables("se3", keys, poses, True), Variables("point3", point_key)),
        (Factors("bearing_se3", ends, ways, information),),
    )
    np.testing.assert_allclose(placed(batch, "point3"), point, rtol=1e-12)


@pytest.mark.parametrize("poses", [[[0, 0, 0.0]], [[0, 0, 0], [0, 0, 1.0]]])
def test_bearings_from_one_place_place_nothing(poses: list[list[float]]) -> None:
    solver = Solver(Options(mode="inc-l"))
    with pytest.raises(Uninitialized, match="l0"):
        solver.stage(sees(np.array(poses), np.zeros(len(poses))))
