"""`factorbus watch`: the recording holds what the map had, and the served page shows it in a real browser."""

import re
import signal
import socket
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import free_port, needs_browser, page_of, picture_of, share_of
from processes import Process
from turned import closing, in_one

from factorbus.cli.output.exits import OK
from factorbus.client import connect
from factorbus.proto.messages import Variables
from factorbus.proto.ports import PortTaken
from factorbus.simulate import city_trees, manhattan
from factorbus.viz import style
from factorbus.viz.geometry import feature_rays
from factorbus.viz.map_follower import Look, MapFollower

pytest.importorskip("rerun")

from factorbus.viz import live


def rows(path: Path) -> dict[str, dict[int, dict[str, Any]]]:
    """entity → revision → component → value, of an .rrd file."""
    from rerun.chunk import RrdReader

    found: dict[str, dict[int, dict[str, Any]]] = defaultdict(lambda: defaultdict(dict))
    for chunk in RrdReader(str(path)).stream().to_chunks():
        if chunk.is_static or "revision" not in chunk.timeline_names:
            continue
        for row in chunk.to_record_batch().to_pylist():
            found[chunk.entity_path][row["revision"]] |= {k: v for k, v in row.items() if v is not None}
    return found


def test_a_part_of_a_map_is_watched_without_the_rest(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    path, box = tmp_path / "part.rrd", "--box=-4,-4,4,4"
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("partly") as joined:
        for step in city_trees(poses=60, seed=2):
            joined.insert(step.batch)
        joined.wait_converged(60)
        watch = ("-m", "factorbus.cli", "watch", "partly", "--connect", endpoint, "--save", str(path))
        watcher = spawn(*watch, "--only", "x", box, "--period-ms", "20", "--bytes-per-s", "100000")
        watcher.ready()
        (interest,) = joined.stats()["interests"]
        assert (interest["letters"], interest["box"]) == (["x"], [-4.0, -4.0, 4.0, 4.0])
        poses = joined.estimate.columns("se2")[1]
        near = poses[(np.abs(poses[:, :2]) <= 4.0).all(axis=1)]
        watcher.signal(signal.SIGINT)
        assert watcher.wait() == OK
    assert re.search(r"its part came in [\d,]+ bytes", watcher.errors())
    found = rows(path)
    strips = [strip for row in found["/map/trajectory/x"].values() for strip in row["LineStrips3D:strips"]]
    assert 0 < len(near) < len(poses)
    assert sum(map(len, strips)) <= len(near)
    points = [row.get("Points3D:positions", ()) for row in found["/map/landmarks"].values()]
    assert max(map(len, points), default=0) <= 1, "the robot, and no tree"


def test_a_part_that_is_none_is_refused_before_anything_is_asked(spawn: Callable[..., Process]) -> None:
    for wrong, said in (
        ("--box=1,2,3", "4 or 6"),
        ("--box=a,b", "4 or 6"),
        ("--kind=se9", "se9"),
        ("--only=1", "letter"),
    ):
        watcher = spawn("-m", "factorbus.cli", "watch", "m", "--connect", "tcp/127.0.0.1:1", "--save", "x.rrd", wrong)
        assert watcher.wait() != OK
        assert said in watcher.errors(), wrong


def test_the_recording_has_every_step_and_the_map_at_the_end(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    steps = list(city_trees(poses=200, seed=2))
    path = tmp_path / "town.rrd"
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("watched") as joined:
        for step in steps[:50]:
            joined.insert(step.batch)
        watcher = spawn("-m", "factorbus.cli", "watch", "watched", "--connect", endpoint, "--save", str(path))
        assert watcher.ready() == [str(path)]
        done = [joined.insert(step.batch) for step in steps[50:]]
        joined.wait_converged(60)
        last = joined.estimate.snapshot()
        watcher.signal(signal.SIGINT)
        assert watcher.wait() == OK
    found = rows(path)
    chi2 = {revision: row["Scalars:scalars"] for revision, row in found["/plots/chi2"].items()}
    assert [chi2[step.revision][0] for step in done] == [step.report["chi2"] for step in done]
    strip = np.array(found["/map/trajectory/x"][last.revision]["LineStrips3D:strips"][0])
    np.testing.assert_allclose(strip[:, :2], last.columns["se2"][1][:, :2], rtol=1e-6, atol=1e-6)
    trees = np.array(found["/map/landmarks"][last.revision]["Points3D:positions"])
    np.testing.assert_allclose(trees[:, :2], last.columns["point2"][1], rtol=1e-6, atol=1e-6)
    rings = found["/map/where_it_may_be"][last.revision]["LineStrips3D:strips"]
    assert len(rings) > 31, "of poses and of trees"
    middles = np.array([np.mean(ring[:-1], axis=0)[:2] for ring in rings])
    places = np.concatenate([last.columns["se2"][1][:, :2], last.columns["point2"][1]])
    assert np.linalg.norm(middles[:, None] - places, axis=2).min(axis=1).max() < 1e-3, "around what they are of"
    assert done[-1].report["because"] in found["/log"][done[-1].revision]["TextLog:text"][0]


def test_a_last_look_has_the_values_that_go_with_its_factors(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The answer with the factors comes before the deltas of the steps before it, on a machine that is busy."""
    steps = list(city_trees(poses=20, seed=2))
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("overtaken") as joined:
        done = [joined.insert(step.batch) for step in steps]
        waited, wait_for = list[int](), joined.estimate.wait_for

        def spy(revision: int, timeout_s: float) -> None:
            waited.append(revision)
            wait_for(revision, timeout_s)

        monkeypatch.setattr(joined.estimate, "wait_for", spy)
        with MapFollower(joined) as follower:
            look = follower.last_look(60)
    assert waited == [look.factors_revision]
    assert look.revision >= look.factors_revision >= done[-1].revision


def test_the_last_look_is_drawn_however_large_the_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "_POSITIONS_PER_S", 1e-6)
    view = live.LiveView("large")
    view.save(tmp_path / "large.rrd")
    for revision, last in ((1, False), (2, False), (3, True)):
        poses = Variables("se2", np.arange(5), np.full((5, 3), float(revision)))
        view.show(Look(1, revision, (poses,), (), (), revision, False), last)
    view.close()
    assert list(rows(tmp_path / "large.rrd")["/map/trajectory/poses"]) == [1, 3]


def test_the_plots_begin_with_the_steps_before_the_viewer_came(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    path, steps = tmp_path / "late.rrd", list(city_trees(poses=80, seed=2))
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("late") as joined:
        before = [joined.insert(step.batch) for step in steps[:60]]
        history = joined.ask.history().result()
        assert {step.revision for step in before} <= set(history.revisions.tolist())
        watcher = spawn("-m", "factorbus.cli", "watch", "late", "--connect", endpoint, "--save", str(path))
        watcher.ready()
        after = [joined.insert(step.batch) for step in steps[60:]]
        joined.wait_converged(60)
        watcher.signal(signal.SIGINT)
        assert watcher.wait() == OK
    found = rows(path)
    for name in ("chi2", "step_ms", "eliminated", "changed"):
        plot = {revision: row["Scalars:scalars"] for revision, row in found[f"/plots/{name}"].items()}
        for step in (*before, *after):
            assert plot[step.revision] == [step.report[name]], f"{name} of {step.revision}, once"


def test_the_log_says_while_a_map_is_converging(endpoint: str, spawn: Callable[..., Process], tmp_path: Path) -> None:
    path, poses = tmp_path / "turned.rrd", 1000
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("turning", "all-batch") as joined:
        joined.insert(in_one(poses, 90.0))
        watcher = spawn("-m", "factorbus.cli", "watch", "turning", "--connect", endpoint, "--save", str(path))
        watcher.ready()
        closed = joined.insert(closing(poses)).revision
        joined.wait_converged(60)
        last = joined.estimate.revision
        watcher.signal(signal.SIGINT)
        assert watcher.wait() == OK
    said = {revision: row["TextLog:text"][0] for revision, row in rows(path)["/log"].items()}
    converging = [revision for revision, text in said.items() if text.endswith("; converging: further steps follow")]
    assert converging == list(range(closed, last))
    assert said[last].startswith("all-batch: the map goes on converging")
    assert f"watched turning up to revision {last}\n" in watcher.errors()


@needs_browser
def test_a_browser_shows_the_served_view(endpoint: str, spawn: Callable[..., Process], tmp_path: Path) -> None:
    ports = ["--web-port", str(free_port()), "--data-port", str(free_port())]
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("served") as joined:
        for step in manhattan(poses=150, seed=2):
            joined.insert(step.batch)
        watcher = spawn("-m", "factorbus.cli", "watch", "served", "--connect", endpoint, "--serve", *ports)
        (url,) = watcher.ready()
        with page_of(url) as page:
            end = time.monotonic() + 90
            while not is_drawn(picture_of(page)) and time.monotonic() < end:
                page.wait_for_timeout(500)  # the viewer draws into a canvas: there is nothing else to wait on
            assert is_drawn(picture_of(page)), "the way, and the ellipses around it"
            page.screenshot(path=tmp_path / "watch.png")  # for a person to look at
        watcher.signal(signal.SIGINT)
        assert watcher.wait() == OK


def is_drawn(picture: np.ndarray) -> bool:
    return share_of(picture, style.ESTIMATE) >= 5e-4 and share_of(picture, style.UNCERTAINTY) >= 1e-4


def test_rays_point_where_the_features_angles_say_and_end_at_the_horizon() -> None:
    features = Variables("idp", np.array([1, 2]), np.array([[1.0, 2, 3, 0.3, -0.2, 0.25], [0, 0, 0, 0, 0, 1e-9]]))
    rays = feature_rays([features], horizon_m=30.0).places
    np.testing.assert_array_equal(rays[0, 0], [1, 2, 3])
    h = rays[0, 1] - rays[0, 0]
    assert np.linalg.norm(h) == pytest.approx(4.0)
    assert np.arctan2(h[0], h[2]) == pytest.approx(0.3)
    assert np.arctan2(-h[1], np.hypot(h[0], h[2])) == pytest.approx(-0.2)
    np.testing.assert_allclose(rays[1, 1], [0, 0, 30])


def test_a_map_that_is_yet_to_come_is_waited_for(endpoint: str, spawn: Callable[..., Process], tmp_path: Path) -> None:
    path = tmp_path / "a.rrd"
    watcher = spawn("-m", "factorbus.cli", "watch", "later", "--connect", endpoint, "--save", str(path))
    watcher.said("there is no map 'later' here;")
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("later") as joined:
        for step in manhattan(poses=5, seed=1):
            joined.insert(step.batch)
        assert watcher.ready() == [str(path)]
        watcher.signal(signal.SIGINT)
        assert watcher.wait() == OK
    waiting = spawn("-m", "factorbus.cli", "watch", "never", "--connect", endpoint, "--save", str(path))
    waiting.said("there is no map 'never' here;")
    waiting.signal(signal.SIGINT)
    assert waiting.wait() == OK
    assert "stopped before there was a map never" in waiting.errors()


def test_the_viewer_listens_on_this_machine_alone_and_ends_with_the_process_that_started_it() -> None:
    from factorbus.viz.viewer_process import Viewer

    data, web = free_port(), free_port()
    viewer = Viewer("127.0.0.1", data, web)
    try:
        with pytest.raises(PortTaken, match=f":{data} is taken"):
            Viewer("127.0.0.1", data, web)
        # Any other address of this machine, as one of 127/8 that is not 127.0.0.1, is not listened at.
        for port in (data, web):
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(("127.0.0.2", port), timeout=5)
            socket.create_connection(("127.0.0.1", port), timeout=5).close()
    finally:
        viewer.stop()
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", data), timeout=5)
