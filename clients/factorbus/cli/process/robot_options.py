"""The options that say what of a robot is read, and how: of the bridge, and of its recordings."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

from factorbus.cli.process.options import Number

F = TypeVar("F", bound=Callable[..., Any])


def robot_options(usual: bool) -> Callable[[F], F]:
    """The fields of `ros2.options.RobotOptions`.  usual: what is not named has its usual name, else it is found."""
    odom, poses, landmarks = (
        ("/odom", "/initialpose", "/detections") if usual else ("", "none", "all of that type in the recording")
    )
    of_type = "" if usual else "  [default: found by its type, and said]"

    def with_options(command: F) -> F:
        for option in reversed((
            click.option(
                "--odom", default=odom, show_default=usual, metavar="TOPIC",
                help=f"nav_msgs/Odometry, to read.{of_type}",
            ),
            click.option(
                "--pose", "poses", multiple=True, metavar="TOPIC",
                help=f"geometry_msgs/PoseWithCovarianceStamped, to read.  [default: {poses}]",
            ),
            click.option(
                "--landmarks", multiple=True, metavar="TOPIC",
                help=f"vision_msgs/Detection3DArray, to read.  [default: {landmarks}]",
            ),
            click.option("--map-frame", default="map", show_default=True, metavar="FRAME", help="Frame of poses."),
            click.option("--space", is_flag=True, help="Poses in space (se3, point3), not in the plane (se2, point2)."),
            click.option(
                "--letter", default="x", show_default=True, metavar="LETTER", help="Of this robot's keys: one for each."
            ),
            click.option(
                "--start", type=click.Choice(("odometry", "pose")), default="odometry", show_default=True,
                help="Where the map begins: where odometry does, or with the first pose that is received.",
            ),
            click.option(
                "--keyframe", nargs=2, type=Number(min=0, min_open=True), default=(0.5, 0.35), show_default=True,
                metavar="METRES RADIANS", help="Least way or turn between two poses of the map.",
            ),
            click.option(
                "--mount", "mounts", multiple=True, metavar="FRAME=x,y,z,qx,qy,qz,qw",
                help="Where a sensor's frame is on the robot.",
            ),
            click.option(
                "--drift", nargs=2, type=Number(min=0, min_open=True), default=(0.02, 0.02), show_default=True,
                metavar="PER_METRE PER_RADIAN", help="Odometry is not believed to be better than this.",
            ),
        )):  # fmt: skip
            command = option(command)
        return command

    return with_options
