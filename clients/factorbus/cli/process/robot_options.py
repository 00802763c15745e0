"""The options that say what of a robot is read, and how: of the bridge, and of its recordings."""

from collections.abc import Callable
from typing import Any, TypeVar

import click

from factorbus.cli.process.options import Number
from factorbus.ros2.options import USUAL_IMU_NOISE

F = TypeVar("F", bound=Callable[..., Any])


def robot_options(usual: bool) -> Callable[[F], F]:
    """The fields of `ros2.options.RobotOptions`.  usual: what is not named has its usual name, else it is found."""
    odom, poses, landmarks = (
        ("/odom", "/initialpose", "/detections") if usual else ("", "none", "all of that type in the recording")
    )
    graphs, fixes = ("none", "none") if usual else ("all of that type in the recording", "one of that type, and said")
    of_type = "" if usual else "  [default: found by its type, and said]"

    def with_options(command: F) -> F:
        for option in reversed((
            click.option(
                "--odom", default=odom, show_default=usual, metavar="TOPIC",
                help=f"nav_msgs/Odometry, to read.{of_type}",
            ),
            click.option(
                "--pose", "poses", multiple=True, metavar="TOPIC|none",
                help=f"geometry_msgs/PoseWithCovarianceStamped, to read.  [default: {poses}]",
            ),
            click.option(
                "--landmarks", multiple=True, metavar="TOPIC|none",
                help=f"vision_msgs/Detection3DArray, to read.  [default: {landmarks}]",
            ),
            click.option(
                "--landmark-list", "landmark_lists", multiple=True, metavar="TOPIC|none",
                help=f"cartographer_ros_msgs/LandmarkList, likewise.  [default: {graphs}]",
            ),
            click.option(
                "--tags", multiple=True, metavar="TOPIC|none",
                help=f"AprilTagDetectionArray of apriltag_ros, likewise.  [default: {graphs}]",
            ),
            click.option(
                "--pose-graph", "pose_graphs", multiple=True, metavar="TOPIC|none",
                help=f"pose_graph_tools_msgs/PoseGraph, whose loop closures to read.  [default: {graphs}]",
            ),
            click.option(
                "--map-graph", "map_graphs", multiple=True, metavar="TOPIC|none",
                help=f"rtabmap_msgs/MapGraph, likewise.  [default: {graphs}]",
            ),
            click.option(
                "--link", "links", multiple=True, metavar="TOPIC|none",
                help=f"rtabmap_msgs/Link, between nodes of a MapGraph.  [default: {graphs}]",
            ),
            click.option(
                "--fix", "fixes", multiple=True, metavar="TOPIC|none",
                help=f"sensor_msgs/NavSatFix, to read.  [default: {fixes}]",
            ),
            click.option(
                "--fix-sigma", type=Number(min=0, min_open=True), default=5.0, show_default=True, metavar="METRES",
                help="Of fixes whose covariance is of unknown type.",
            ),
            click.option(
                "--imu", default="", metavar="TOPIC",
                help="sensor_msgs/Imu, raw samples to read between poses in space (--space).  [default: none]",
            ),
            click.option(
                "--imu-noise", nargs=4, type=Number(min=0, min_open=True), default=USUAL_IMU_NOISE, show_default=True,
                metavar="GYRO ACC GYRO_WALK ACC_WALK",
                help="Noise densities, rad/s/√Hz and m/s²/√Hz, and of the biases' walks, per √s.",
            ),
            click.option(
                "--robot-id", type=int, metavar="N", help="Of this robot in pose graphs.  [default: of the first node]"
            ),
            click.option(
                "--rotation-first", is_flag=True,
                help="Covariances of pose graphs have rotation before translation, as GTSAM's.",
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
