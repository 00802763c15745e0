"""Pictures of maps: what is drawn is what was given, in every form a file can have."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.simulate import Spiral, city_trees, manhattan, sphere
from factorbus.viz import BadPicture, DriveHistory, MapLayers, Odometry, loops_of, map_figure, save_map

pytest.importorskip("matplotlib")


def poses(kind: str, values: np.ndarray, letter: str = "x") -> Variables:
    return Variables(kind, symbol(letter, 0) + np.arange(len(values)), np.asarray(values, float))


def square(corners: int = 5) -> Variables:
    turn = np.arange(corners) * np.pi / 2
    return poses("se2", np.stack([10 * np.cos(turn), 10 * np.sin(turn), turn], axis=1))


def drive(steps) -> tuple[list[Variables], Odometry, np.ndarray]:
    """(truth, odometry, loops) of a simulated drive."""
    truth, odometry, loops = [], Odometry(), []
    for step in steps:
        truth += step.truth
        odometry.add(step.batch)
        loops.append(loops_of(step.batch))
    return truth, odometry, np.concatenate(loops)


def lines_of(figure) -> dict[str, np.ndarray]:
    """Label → data of the lines of the map."""
    return {
        line.get_label(): np.array(line.get_data_3d() if hasattr(line, "get_data_3d") else line.get_data()).T
        for line in figure.axes[0].lines
    }


def names_in_legend(figure) -> list[str]:
    return [text.get_text() for axes in figure.axes if axes.get_legend() for text in axes.get_legend().get_texts()]


@pytest.mark.parametrize(("ending", "magic"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".PDF", b"%PDF")])
def test_file_is_what_its_ending_says(tmp_path: Path, ending: str, magic: bytes) -> None:
    path = tmp_path / f"map{ending}"
    save_map(
        path,
        MapLayers([square()], loops=np.array([[symbol("x", 0), symbol("x", 3)]])),
        title="A square",
        subtitle="five poses",
    )
    content = path.read_bytes()
    assert content.startswith(magic)
    assert len(content) > 4000
    if ending == ".svg":
        assert b"A square" in content
        assert b"loop closures (1)" in content


def test_every_layer_is_drawn_and_named() -> None:
    truth, odometry, _ = drive(city_trees(400, 1))
    loops = np.array([[symbol("x", 0), symbol("x", 300)], [symbol("x", 5), symbol("x", 999)]])
    figure = map_figure(
        MapLayers(truth, truth=truth, odometry=odometry.variables(), loops=loops), title="t", subtitle="s"
    )
    trees = sum(len(group.keys) for group in truth if group.kind == "point2")
    assert set(names_in_legend(figure)) == {
        "odometry alone", "truth", "estimate (400 poses)", "loop closures (1)", f"true landmarks ({trees})",
        f"landmarks ({trees})", "start",
    }  # fmt: skip
    where = np.concatenate([group.values for group in truth if group.kind == "se2" and group.values is not None])
    np.testing.assert_array_equal(lines_of(figure)["estimate (400 poses)"], where[:, :2])
    (loop,) = [c for c in figure.axes[0].collections if type(c).__name__ == "LineCollection"]
    np.testing.assert_array_equal(loop.get_segments()[0], where[[0, 300], :2])  # the other has no pose 999
    assert figure.axes[0].get_aspect() == 1.0
    assert figure.axes[0].get_title(loc="left") == "s"
    assert "(m)" in figure.axes[0].get_xlabel()


def test_known_things_are_in_the_picture_and_odometry_far_out_is_not() -> None:
    far = poses("se2", np.array([[0, 0, 0], [5000, 0, 0]]))
    axes = map_figure(MapLayers([square()], odometry=[far])).axes[0]
    assert axes.get_xlim()[0] < -10 < 10 < axes.get_xlim()[1] < 20
    assert axes.get_ylim()[0] < -10 < 10 < axes.get_ylim()[1]


def test_two_robots_are_two_lines() -> None:
    line = lines_of(map_figure(MapLayers([square(), poses("se2", np.ones((2, 3)), "y")])))["estimate (7 poses)"]
    assert np.isnan(line).any(axis=1).tolist() == [False] * 5 + [True] + [False] * 2


def test_space_is_drawn_in_space_and_a_floor_in_the_plane() -> None:
    truth, odometry, loops = drive(sphere(300, 1, spiral=Spiral(20, 15)))
    figure = map_figure(MapLayers(truth, odometry.variables(), loops=loops))
    assert figure.axes[0].name == "3d"
    figure.canvas.draw()
    floor = np.zeros((40, 7))
    floor[:, 0], floor[:, 1] = np.cos(np.arange(40)), np.arange(40)
    floor[:, 2], floor[:, 6] = 0.01 * np.arange(40) % 2, 1
    figure = map_figure(MapLayers([poses("se3", floor)]))
    assert figure.axes[0].name == "rectilinear"
    np.testing.assert_array_equal(lines_of(figure)["estimate (40 poses)"], floor[:, :2])
    wall = floor[:, [0, 2, 1, 3, 4, 5, 6]]  # stands upright: drawn along its own two axes
    figure = map_figure(MapLayers([poses("se3", wall)]))
    assert figure.axes[0].get_xlabel() == "widest axis (m)"
    drawn = lines_of(figure)["estimate (40 poses)"]
    np.testing.assert_allclose(np.ptp(drawn, axis=0), np.ptp(wall[:, [2, 0]], axis=0), rtol=0.05)


@pytest.mark.parametrize(("axis", "labels"), [(0, "xy"), (1, "xy"), (2, "xz")])
def test_a_straight_drive_is_drawn_along_its_own_axis_and_not_as_a_sliver(axis: int, labels: str) -> None:
    line = np.zeros((20, 7))
    line[:, axis], line[:, 6] = np.arange(20), 1
    line[:, 2] += 1.0  # not at the origin
    axes = map_figure(MapLayers([poses("se3", line)])).axes[0]
    assert (axes.get_xlabel(), axes.get_ylabel()) == tuple(f"{name} (m)" for name in labels)
    sides = np.array([np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())])
    assert sides.min() / sides.max() > 0.3
    assert sides.max() == pytest.approx(19 * 1.08)


def test_panels_show_the_course() -> None:
    history = DriveHistory(
        chi2=np.linspace(0, 90, 50), step_ms=np.full(50, 2.5), optimum=np.array([[25, 40.0], [50, 88.0]])
    )
    figure = map_figure(MapLayers([square()]), history=history)
    chi2, times = figure.axes[2:]
    np.testing.assert_array_equal(chi2.lines[0].get_ydata(), history.chi2)
    np.testing.assert_array_equal(chi2.lines[1].get_xydata(), history.optimum)
    assert [text.get_text() for text in times.get_legend().get_texts()] == ["p50  2.5 ms", "p99  2.5 ms"]
    assert [text.get_text() for text in chi2.get_legend().get_texts()] == ["after the step", "batch optimum"]
    figure.canvas.draw()
    assert len(map_figure(MapLayers([square()]), history=DriveHistory(chi2=np.ones(3))).axes) == 3
    assert len(map_figure(MapLayers([square()]), history=DriveHistory()).axes) == 2


def test_an_optimum_that_had_not_converged_is_drawn_and_called_so() -> None:
    early = np.array([[30, 41.0]])
    history = DriveHistory(chi2=np.linspace(0, 90, 50), optimum=np.array([[25, 40.0]]), not_converged=early)
    chi2 = map_figure(MapLayers([square()]), history=history).axes[2]
    drawn = {line.get_label(): line for line in chi2.lines}
    np.testing.assert_array_equal(drawn["batch, not converged"].get_xydata(), early)
    assert drawn["batch, not converged"].get_marker() != drawn["batch optimum"].get_marker()
    assert len(chi2.get_legend().get_texts()) == 3
    alone = map_figure(MapLayers([square()]), history=DriveHistory(chi2=np.ones(50), not_converged=early)).axes[2]
    assert [text.get_text() for text in alone.get_legend().get_texts()] == ["after the step", "batch, not converged"]


@pytest.mark.parametrize("count", [1, 2])
def test_the_smallest_maps(tmp_path: Path, count: int) -> None:
    save_map(tmp_path / "a.png", MapLayers([square(count)], truth=[square(count)], odometry=[square(count)]))
    save_map(tmp_path / "b.png", MapLayers([Variables("point3", np.arange(count), np.ones((count, 3)))]))
    assert (tmp_path / "b.png").stat().st_size > 2000


def test_what_cannot_be_drawn(tmp_path: Path) -> None:
    with pytest.raises(BadPicture, match=r"cannot be a \.jpeg; wanted \.png, \.svg, \.pdf"):
        save_map(tmp_path / "map.jpeg", MapLayers([square()]))
    with pytest.raises(BadPicture, match="neither a pose nor a point"):
        save_map(tmp_path / "map.png", MapLayers([Variables("se2", np.arange(3))]))
    assert not any(tmp_path.iterdir())


def test_a_large_map_is_drawn_as_pixels_and_its_loops_in_part(tmp_path: Path) -> None:
    count = 200_000
    turn = np.arange(count) / 3000
    track = poses("se2", np.stack([turn * np.cos(turn), turn * np.sin(turn), turn], axis=1))
    loops = symbol("x", 0) + np.stack([np.arange(count - 19000), np.arange(19000, count)], axis=1)
    save_map(tmp_path / "large.svg", MapLayers([track], loops=loops))
    assert (tmp_path / "large.svg").stat().st_size < 5e6  # as pixels; as lines it would be tens of megabytes
    assert b"loop closures (181,000, one in 2 drawn)" in (tmp_path / "large.svg").read_bytes()


def test_odometry_without_noise_is_the_truth() -> None:
    for steps in (
        manhattan(300, 1, sigma_xy_m=1e-12, sigma_theta_rad=1e-12),
        sphere(300, 1, sigma_xyz_m=1e-12, sigma_rotation_rad=1e-12),
    ):
        truth, odometry, _ = drive(steps)
        (reckoned,) = odometry.variables()
        exact = np.concatenate([group.values for group in truth if group.values is not None])
        assert reckoned.values is not None
        np.testing.assert_array_equal(reckoned.keys, np.concatenate([group.keys for group in truth]))
        np.testing.assert_allclose(reckoned.values[:, :2], exact[:, :2], atol=1e-8)
        if exact.shape[1] == 7:
            np.testing.assert_allclose(reckoned.values[:, 2], exact[:, 2], atol=1e-8)
            np.testing.assert_allclose(np.abs(np.sum(reckoned.values[:, 3:] * exact[:, 3:], axis=1)), 1)


def test_odometry_hears_edges_in_any_direction_and_only_the_first() -> None:
    x = [symbol("x", number) for number in range(4)]
    keys = np.array([[x[2], x[1]], [x[1], x[0]], [x[2], x[3]]])
    measured = np.array([[-1, 0, 0], [0, 1, -np.pi / 2], [1, 0, 0]])
    odometry = Odometry()
    odometry.add(Batch((Variables("se2", np.array(x[:1]), np.array([[5.0, 5, 0]]), True),), ()))
    odometry.add(Batch((), (Factors("between_se2", keys, measured, np.ones((3, 6))),)))
    odometry.add(Batch((), (Factors("between_se2", keys[::-1], measured + 50, np.ones((3, 6))),)))
    (found,) = odometry.variables()
    assert found.values is not None
    places = dict(zip(found.keys.tolist(), found.values[:, :2], strict=True))
    for key, place in zip(x, [[5, 5], [6, 5], [6, 6], [6, 7]], strict=True):
        np.testing.assert_allclose(places[key], place, atol=1e-12)


def test_loops_are_edges_that_skip_a_pose() -> None:
    x = [symbol("x", number) for number in (0, 2, 3, 7)]  # other numbers went to points
    keys = np.array([[x[0], x[1]], [x[2], x[1]], [x[2], x[3]], [x[3], x[1]], [x[0], x[2]]])
    edges = Factors("between_se2", keys, np.zeros((5, 3)), np.zeros((5, 6)))
    np.testing.assert_array_equal(loops_of(Batch((), (edges,))), keys[3:])
    assert loops_of(Batch()).shape == (0, 2)


def test_matplotlib_is_not_imported_before_it_is_needed() -> None:
    code = "import sys, factorbus.viz; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
