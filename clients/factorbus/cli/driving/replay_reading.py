"""What `factorbus replay` reads: a graph file or a robot's recording, and the options that are of one of them."""

from dataclasses import fields
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from factorbus.cli.output.console import reading
from factorbus.cli.output.exits import require
from factorbus.cli.process.reading import is_recording, read_drive, say
from factorbus.ros2.options import RobotOptions

# What is given one by one, and collected under the name of several.
_ONCE = {
    "poses": "pose", "mounts": "mount", "pose_graphs": "pose_graph", "map_graphs": "map_graph", "links": "link",
    "fixes": "fix", "landmark_lists": "landmark_list",
}  # fmt: skip


def check_kind(file: Path) -> None:
    """Raises UsageError: an option is of recordings, or of graph files, and FILE is the other."""
    given = click.get_current_context().get_parameter_source
    of_graphs, of_recordings = (
        ("use_values", "dialect"),
        ("rate", "params_file", *(each.name for each in fields(RobotOptions))),
    )
    recorded = is_recording(file)
    for name in of_graphs if recorded else of_recordings:
        if given(name) is ParameterSource.COMMANDLINE:
            option = "--" + _ONCE.get(name, name).replace("_", "-")
            is_of = "graph files, and this is a recording" if recorded else "recordings (.mcap, .bag, rosbag2)"
            raise click.UsageError(f"{option} is of {is_of}")


def read_steps(
    file: Path, robot: RobotOptions | None, dialect: str | None, strict: bool, use_values: bool
) -> tuple[Any, Any]:
    """The graph or the recording in a file, and its steps.  Raises FormatError, BadRecording."""
    if not is_recording(file):
        graph = read_drive(file, dialect, strict)
        return graph, graph.steps(use_values=use_values)
    require("ros2", "a recording")
    from factorbus.ros2.recorded_drive import read_recording
    from factorbus.ros2.settings import Settings, robot_settings

    settings = robot_settings(robot) if robot else Settings(odometry="", poses=(), landmarks=())
    with reading(file.name) as show:
        drive = read_recording(file, settings, strict, show)
    say(file, drive.notes)
    return drive, drive.steps
