"""`factorbus plot`: what the pictures show is so, and how the command ends."""

import json
from pathlib import Path

import numpy as np
import pytest
from few_tries import give_up_after

from factorbus.cli.driving.columns import merged, positions
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK, USAGE
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol
from factorbus.simulate import city_trees, manhattan
from factorbus.viz import DriveHistory, MapLayers, drive_figure, map_figure, sparsity_figure, spread_of
from factorbus.viz.ellipses import QUANTILE, outlines
from factorbus.viz.geometry import view_of

pytest.importorskip("matplotlib")


def graph_of(steps) -> Batch:
    return merged(step.batch for step in steps)


@pytest.mark.parametrize("world", [manhattan, city_trees], ids=["manhattan", "city-trees"])
def test_pattern_has_the_nonzeros_that_the_solver_counts(world) -> None:
    from factorbus.cli.output.sparsity import pattern_of
    from factorbus.solver.sparse.ordering import order
    from factorbus.solver.sparse.symbolic import analyze

    graph = graph_of(world(poses=300, seed=3))
    pattern = pattern_of(graph)
    free = {key: group.kind for group in graph.variables if not group.fixed for key in group.keys.tolist()}
    dims = np.array([3 if free[key] == "se2" else 2 for key in sorted(free)])
    place = {key: index for index, key in enumerate(sorted(free))}
    pairs = {
        tuple(sorted((place[i], place[j])))
        for group in graph.factors
        for i, j in group.keys.tolist()
        if i in place and j in place
    }
    assert {tuple(pair) for pair in pattern.inserted.tolist()} == pairs
    diagonal = np.arange(len(dims))
    rows = np.concatenate([diagonal, pattern.inserted[:, 0]])
    cols = np.concatenate([diagonal, pattern.inserted[:, 1]])
    group = np.zeros(len(dims), np.int64)
    group[-1] = 1  # the last pose: x comes after l
    assert pattern.nnz_r == analyze(dims, rows, cols, order(dims, rows, cols, group)).nnz_r
    assert pattern.nnz_unordered == analyze(dims, rows, cols, diagonal).nnz_r
    assert pattern.eliminated.max() == len(dims) - 1


def test_fill_is_what_dense_elimination_of_the_pattern_gives() -> None:
    from factorbus.cli.output.sparsity import pattern_of

    pattern = pattern_of(graph_of(manhattan(poses=80, seed=1)))
    there = np.zeros((pattern.n, pattern.n), bool)
    there[tuple(pattern.eliminated.T)] = True
    before = there.copy()
    for i in range(pattern.n):
        row = np.flatnonzero(there[i])
        there[np.ix_(row, row)] |= row[:, None] < row
    np.testing.assert_array_equal(np.argwhere(there & ~before), pattern.fill[np.lexsort(pattern.fill.T[::-1])])


def test_sparsity_is_drawn_block_by_block() -> None:
    from factorbus.cli.output.sparsity import pattern_of

    pattern = pattern_of(graph_of(manhattan(poses=80, seed=1)))
    figure = sparsity_figure(pattern, "a title")
    images = [axes.images[0].get_array() for axes in figure.axes]
    assert [axes.get_title(loc="left") for axes in figure.axes][2] == "R"
    painted = [(np.asarray(image) < 1).any(axis=2).sum() for image in images]
    assert painted == [pattern.n + 2 * len(pattern.inserted)] * 2 + [
        pattern.n + len(pattern.inserted) + len(pattern.fill)
    ]


def test_a_drive_shows_every_step_by_what_it_did() -> None:
    history = DriveHistory(np.linspace(0, 5, 40), np.full(40, 0.5), np.array([[20.0, 2.0]]))
    figure = drive_figure(history, ["extend"] * 30 + ["omega"] * 9 + ["full"], "a drive", "40 steps")
    times = figure.axes[1]
    marks = {line.get_label(): len(line.get_xdata()) for line in times.lines if "(" in str(line.get_label())}
    assert marks == {"extend (30)": 30, "omega (9)": 9, "full (1)": 1}
    assert figure.axes[2].lines[0].get_ydata()[-1] == pytest.approx(0.02)
    work = np.stack([np.arange(1, 41), np.full(40, 3), np.eye(40)[7]], axis=1).astype(float)
    worked = drive_figure(DriveHistory(history.chi2, history.step_ms, work=work), ["tree"] * 40).axes[3]
    marks = {line.get_label(): line.get_xdata().tolist() for line in worked.lines}
    assert (len(marks["eliminated"]), marks["relinearized"]) == (40, [8]), (
        "steps that relinearized nothing have no mark"
    )


def test_ellipses_hold_95_percent_of_what_a_covariance_says() -> None:
    """Samples of the tangent, added to the pose as the wire says; the share of them inside the line that is drawn."""
    rng = np.random.default_rng(4)
    root = np.array([[0.3, 0, 0], [0.2, 0.1, 0], [0.05, 0.02, 0.01]])
    pose = Variables("se2", np.array([symbol("x", 1)]), np.array([[3.0, -2.0, 1.1]]))
    spread = spread_of([pose], {symbol("x", 1): root @ root.T})
    line = outlines(spread, view_of(spread.places[:, :2]))[0]
    delta = rng.normal(size=(4000, 3)) @ root.T
    c, s = np.cos(1.1), np.sin(1.1)
    away = delta[:, :2] @ np.array([[c, s], [-s, c]])
    from matplotlib.path import Path as Line

    inside = Line(line).contains_points(away + np.array([3.0, -2.0])).mean()
    assert inside == pytest.approx(0.95, abs=0.012)


def test_in_space_three_lines_go_round_each_place() -> None:
    places = np.random.default_rng(0).normal(size=(30, 3)) * 5
    keys = symbol("l", 0) + np.arange(30)
    points = Variables("point3", keys, places)
    blocks = {int(key): np.diag([0.01, 0.04, 0.09]) for key in keys}
    spread = spread_of([points], blocks)
    lines = outlines(spread, view_of(places))
    assert lines.shape[0] == 90
    distance = (lines - np.tile(places, (3, 1))[:, None]) / [0.1, 0.2, 0.3]
    np.testing.assert_allclose(np.linalg.norm(distance, axis=2), QUANTILE[3], rtol=1e-9)
    figure = map_figure(MapLayers([points], spread=spread))
    legend = [text.get_text() for axes in figure.axes if axes.get_legend() for text in axes.get_legend().get_texts()]
    assert "95 % of where it may be (30)" in legend


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("town") / "town.g2o"
    assert main(["simulate", "manhattan", "--poses", "300", "--out", str(path)]) == OK
    return path


@pytest.mark.parametrize(
    "arguments", [["map"], ["map", "--solve", "--ellipses", "9"], ["drive"], ["sparsity"], ["tree"]]
)
def test_pictures_of_a_file(arguments: list[str], town: Path, tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plot", *arguments, str(town)]) == OK
    said = capsys.readouterr().out.split()
    assert said == [f"town-{arguments[0]}.png"]
    assert (tmp_path / said[0]).read_bytes().startswith(b"\x89PNG")
    svg = tmp_path / "picture.svg"
    assert main(["plot", *arguments, str(town), "--out", str(svg), "--json"]) == OK
    assert json.loads(capsys.readouterr().out) == {"files": [str(svg)]}
    text = svg.read_text()
    assert {"map": "odometry alone", "drive": "relinearized", "sparsity": "fill-in", "tree": "last loop"}[
        arguments[0]
    ] in text
    assert ("95 % of where it may be (9)" in text) == ("--ellipses" in arguments)


def test_a_log_that_knows_the_truth_has_it_in_the_picture(tmp_path: Path) -> None:
    log, svg = tmp_path / "town.jrl", tmp_path / "town.svg"
    assert main(["simulate", "manhattan", "--poses", "30", "--out", str(log)]) == OK
    assert main(["plot", "map", str(log), "--out", str(svg)]) == OK
    assert ">truth<" in svg.read_text()
    assert main(["convert", str(log), str(tmp_path / "town.g2o")]) == OK
    assert main(["plot", "map", str(tmp_path / "town.g2o"), "--out", str(svg)]) == OK
    assert ">truth<" not in svg.read_text()


def test_pictures_say_where_an_optimum_had_not_converged(town: Path, tmp_path: Path, monkeypatch) -> None:
    """Also with the picture of a drive."""
    svg = tmp_path / "picture.svg"
    assert main(["plot", "map", "--solve", str(town), "--out", str(svg)]) == OK
    assert "not converged" not in svg.read_text()
    give_up_after(1, monkeypatch.setattr)
    assert main(["plot", "map", "--solve", str(town), "--out", str(svg)]) == OK
    assert "not converged, the true optimum may be lower" in svg.read_text()
    assert main(["plot", "drive", "--every", "100", str(town), "--out", str(svg)]) == OK
    assert "batch, not converged" in svg.read_text()


def test_odometry_is_reckoned_and_not_the_files_values(town: Path, tmp_path: Path) -> None:
    """A solved graph has its estimate in the vertices; the line of odometry must not follow it."""
    from factorbus.cli.driving.picture import reckoned
    from factorbus.cli.driving.plot_source import graph_of as source_of
    from factorbus.cli.driving.plot_source import solved

    drawn = solved(source_of(str(town), None))
    (alone,) = reckoned(drawn.unsolved())
    keys, here = positions(drawn.graph.variables, ("se2",))
    np.testing.assert_array_equal(keys, np.sort(alone.keys))
    assert alone.values is not None
    apart = np.linalg.norm(alone.values[np.argsort(alone.keys), :2] - here, axis=1)
    assert len(apart) == 300
    assert max(apart) > 1.0


def test_bad_endings_and_files_are_refused_before_the_work(tmp_path: Path, capsys) -> None:
    assert main(["plot", "map", "any.g2o", "--out", str(tmp_path / "map.gif")]) == USAGE
    assert "map.gif does not end in .png or .svg or .pdf" in capsys.readouterr().err
    assert main(["plot", "drive", "missing.g2o", "--out", str(tmp_path / "map.png")]) == BAD_FILE
