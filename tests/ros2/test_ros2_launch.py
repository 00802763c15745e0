"""The launch file starts what it says, with options from a file.  No ROS is here, so its XML is read by rule."""

import json
import re
import shlex
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from processes import Process

from factorbus.cli.commands.ros2 import command
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, UNAVAILABLE
from factorbus.ros2.parameters import BadParameters, node_parameters

FOLDER = Path(__file__).parents[2] / "deploy" / "ros2"
LAUNCH, PARAMETERS = FOLDER / "factorbus.launch.xml", FOLDER / "robot.yaml"
ROBOT = str(Path(__file__).with_name("robot.py"))
# Attributes of <executable> and <arg> in ROS 2's launch_xml, from Humble on.
ATTRIBUTES = {
    "executable": {"cmd", "name", "output", "if", "respawn", "respawn_delay"},
    "arg": {"name", "default", "description"},
}


def launched(given: Mapping[str, str]) -> dict[str, list[str]]:
    """The command of each process, by its name, as `ros2 launch` would start them with name:=value."""
    root = ElementTree.parse(LAUNCH).getroot()
    values: dict[str, str] = {}

    def told(text: str) -> str:
        text = text.replace("$(dirname)", str(LAUNCH.parent))
        return re.sub(r"\$\(var (\w+)\)", lambda found: values[found[1]], text)

    commands = {}
    for each in root:
        assert set(each.attrib) <= ATTRIBUTES[each.tag]
        if each.tag == "arg":
            values[each.attrib["name"]] = given.get(each.attrib["name"], told(each.attrib["default"]))
        elif told(each.attrib.get("if", "true")) == "true":
            commands[each.attrib["name"]] = shlex.split(told(each.attrib["cmd"]))
    assert set(given) <= set(values)
    return commands


def test_a_robot_is_launched_with_a_parameters_file_and_drives(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    file = tmp_path / "robot.yaml"
    text = PARAMETERS.read_text(encoding="utf-8").replace("mount: []", "mount: ['camera=0.3,0,0,0,0,1,1']")
    file.write_text(text + "    display: 0.1\n    domain: 9\n")
    commands = launched(
        {"map": "launched", "connect": endpoint, "ros": endpoint, "params_file": str(file), "serve": "false"}
    )
    assert list(commands) == ["factorbus_bridge"]
    bridge = spawn("-m", "factorbus.cli", *commands["factorbus_bridge"][1:])
    assert bridge.ready() == [endpoint]
    robot = spawn(ROBOT, endpoint, "9")
    robot.ready()
    robot.tell("go")
    said = json.loads(" ".join(robot.line("done")))
    assert np.hypot(*(np.array(said["corrected"]) - np.array(said["true"]))[:2]) < 0.05
    assert said["path"] == ["map", 45]
    bridge.signal(signal.SIGINT)
    assert bridge.wait() == 0


def test_the_launch_file_as_it_stands_starts_a_service_and_waits_for_it(
    spawn: Callable[..., Process], capsys: pytest.CaptureFixture[str]
) -> None:
    """Until the service listens the bridge ends, and is started again: `respawn`."""
    commands = launched({"connect": "tcp/127.0.0.1:0"})
    serve = commands["factorbus_serve"]
    assert serve[:2] == ["factorbus", "serve"]
    (at,) = spawn("-m", "factorbus.cli", *serve[1:], "--no-warm").ready()
    alone = launched({"connect": "tcp/127.0.0.1:1", "ros": at})["factorbus_bridge"]
    assert main(alone[1:]) == UNAVAILABLE
    assert "nothing listens" in capsys.readouterr().err
    bridge = spawn("-m", "factorbus.cli", *launched({"connect": at, "ros": at})["factorbus_bridge"][1:])
    assert bridge.ready() == [at]
    bridge.signal(signal.SIGINT)
    assert bridge.wait() == 0


def test_the_file_of_the_launch_has_the_defaults_of_the_command() -> None:
    """An empty list is the default."""
    usual = {max(each.opts, key=len).lstrip("-").replace("-", "_"): each.default for each in command.params}
    for name, value in node_parameters(PARAMETERS, "/", "factorbus").items():
        if value != []:
            assert usual[name] == (tuple(value) if isinstance(value, list) else value)


TEXT = """
/**: {ros__parameters: {use_sim_time: true, keyframe: [2, 1], odom: /a}}
factorbus: {ros__parameters: {odom: /b}}
robot1: {factorbus: {ros__parameters: {odom: /c}}}
/robot2/*: {ros__parameters: {odom: /d}}
other: {ros__parameters: {odom: /e}}
"""


@pytest.mark.parametrize(
    ("namespace", "node", "odom"),
    [("/", "factorbus", "/b"), ("/robot1", "factorbus", "/c"), ("robot2", "x", "/d"), ("/robot3", "factorbus", "/a")],
)
def test_parameters_are_those_of_the_node(tmp_path: Path, namespace: str, node: str, odom: str) -> None:
    (file := tmp_path / "p.yaml").write_text(TEXT)
    assert node_parameters(file, namespace, node) == {"use_sim_time": True, "keyframe": [2, 1], "odom": odom}


def test_what_is_typed_counts_before_the_file(tmp_path: Path) -> None:
    (file := tmp_path / "p.yaml").write_text(TEXT)
    made = command.make_context("ros2", ["yard", "--params-file", str(file), "--odom", "/typed"])
    assert [made.params[name] for name in ("map_name", "odom", "keyframe")] == ["yard", "/typed", (2.0, 1.0)]
    (file := tmp_path / "named.yaml").write_text(
        "/**: {ros__parameters: {map: hall, space: true, mount: ['a=0,0,0,0,0,0,1']}}"
    )
    made = command.make_context("ros2", ["--params-file", str(file)])
    assert [made.params[name] for name in ("map_name", "space", "mounts")] == ["hall", True, ("a=0,0,0,0,0,0,1",)]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ("/**: {ros__parameters: {odm: /odom}}", "odm is no parameter; wanted odom"),
        ("/**: {ros__parameters: {params_file: a}}", "params_file is no parameter"),
        ("/**: {ros__parameters: {space: 1}}", "space: 1; wanted true or false"),
        ("/**: {ros__parameters: {odom: [/a]}}", "wanted one value"),
        ("/**: {ros__parameters: {odom: true}}", "odom: True; wanted one value"),
        ("/**: {ros__parameters: {keyframe: 1}}", "a list of 2 numbers"),
        ("/**: {ros__parameters: {landmarks: [{}]}}", "a list of values"),
        ("/**: {ros__parameters: [odom]}", "has no names"),
        ("amcl: {ros__parameters: {odom: /odom}}", "nothing of /factorbus, but of /amcl"),
        ("odom: /odom", "no ros__parameters"),
        ("{", "no YAML"),
        ("\x00", "no YAML"),
    ],
)
def test_a_file_that_cannot_be_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, wanted: str
) -> None:
    (file := tmp_path / "p.yaml").write_text(text)
    assert main(["ros2", "yard", "--params-file", str(file)]) == BAD_FILE
    said = capsys.readouterr().err
    assert wanted in said
    assert "[bad_file]" in said


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (file := tmp_path / "p.yaml").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(BadParameters, match="no YAML"):
        node_parameters(file, "/", "factorbus")
