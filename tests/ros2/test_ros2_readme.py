"""The commands of deploy/ros2/README.md work as they stand there, but for the ports; its options and codes exist."""

import re
import shlex
import signal
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
import recordings
import ros
import survey
from processes import Process

from factorbus.cli.commands import replay
from factorbus.cli.commands.ros2 import command
from factorbus.cli.main import main
from factorbus.proto.problems import Unavailable
from factorbus.ros2.messages import TRANSFORMS
from factorbus.ros2.node import open_node
from factorbus.ros2.settings import Floors, Settings

README = (Path(__file__).parents[2] / "deploy" / "ros2" / "README.md").read_text(encoding="utf-8")


BLOCKS = [shlex.split(text)[1:] for text in re.findall(r"^```bash\n(.*?)^```$", README, re.M | re.S)]


def test_a_recording_is_replayed_as_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recordings.write_mcap(tmp_path / "drive.mcap", recordings.drive().said)
    monkeypatch.chdir(tmp_path)
    assert main(BLOCKS[3]) == 0
    assert len((tmp_path / "drive.tum").read_text().splitlines()) == 45
    assert (tmp_path / "drive.png").stat().st_size > 10_000


def test_a_recording_with_a_front_end_and_gnss_is_replayed_as_it_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    survey.write(tmp_path / "drive.mcap", survey.said(survey.survey()))
    monkeypatch.chdir(tmp_path)
    assert main(BLOCKS[4]) == 0
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["drive.mcap", "drive.tum"]
    assert len((tmp_path / "drive.tum").read_text().splitlines()) == survey.COUNT


def test_its_commands_run(spawn: Callable[..., Process]) -> None:
    """The robot's router is another service here: any Zenoh hub is one."""
    serve, join, more, *_, smooth = BLOCKS
    assert serve[-2:] == ["--listen", "tcp/127.0.0.1:7448"]
    assert join[2:] == ["--connect", "tcp/127.0.0.1:7448", "--ros", "tcp/127.0.0.1:7447"]
    ours, theirs = (spawn("-m", "factorbus.cli", *serve[:-1], "tcp/127.0.0.1:0", "--no-warm") for _ in range(2))
    (at,), (router,) = ours.ready(), theirs.ready()
    bridge = spawn("-m", "factorbus.cli", *join[:3], at, "--ros", router)
    assert bridge.ready() == [router]
    with_graph = spawn("-m", "factorbus.cli", *more[:3], at, "--ros", router, "--domain", "1", *more[6:])
    assert with_graph.ready() == [router]
    with_graph.signal(signal.SIGINT)
    assert with_graph.wait() == 0
    smoothed = spawn("-m", "factorbus.cli", *smooth[:3], at, "--ros", router, "--domain", "2", *smooth[6:])
    assert smooth[6:] == ["--smooth-s", "2"]
    assert smoothed.ready() == [router]
    smoothed.signal(signal.SIGINT)
    assert smoothed.wait() == 0
    with ros.session(router) as bus:
        tokens = ros.RosNode(bus, 0).wait_for_endpoints(8)
        assert any(token.endswith("/NN/%/%/factorbus") for token in tokens)
    bridge.signal(signal.SIGINT)
    assert bridge.wait() == 0


def test_where_the_robots_router_is_not_there_it_is_said_how_to_start_it() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(Unavailable, match=rf"^tcp/127.0.0.1:{port} .*`ros2 run rmw_zenoh_cpp rmw_zenohd`"):
        open_node(f"tcp/127.0.0.1:{port}", 0, "/", "factorbus", 0.1, {})
    assert "ros2 run rmw_zenoh_cpp rmw_zenohd" in README


def test_its_options_and_numbers_are_those_of_the_command() -> None:
    options_named = set(re.findall(r"`(--[a-z-]+)", README))
    parameters = [parameter for each in (command, replay.command) for parameter in each.params]
    options = {option for each in parameters for option in (*each.opts, *each.secondary_opts)}
    assert options_named <= options | {"--listen"}
    defaults = Settings()
    assert {defaults.odometry, *defaults.poses, *defaults.landmarks, defaults.transforms} <= set(
        re.findall(r"`(/\w+)`", README)
    )
    floors = Floors()
    assert (floors.drift_m, floors.drift_rad, floors.turn_rad) == (0.02, 0.01, 0.02)
    assert (floors.least_m, floors.least_rad) == (0.001, 0.001)
    assert (floors.pose_m, floors.pose_rad, floors.landmark_m) == (0.01, 0.01, 0.01)
    assert (floors.closure_m, floors.closure_rad, floors.fix_m, defaults.fix_sigma_m) == (0.05, 0.02, 0.01, 5.0)
    every = Settings(
        landmark_lists=("/l",),
        tags=("/t",),
        pose_graphs=("/a",),
        map_graphs=("/b",),
        links=("/c",),
        fixes=("/d",),
        imu="/e",
        space="space",
    )
    named = {f"{package}/msg/{name}" for package, name in re.findall(r"`(\w+)/(\w+)`", README)}
    assert {*every.inputs().values(), TRANSFORMS} <= named
