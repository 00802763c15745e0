"""`factorbus ros2`: a robot that speaks ROS 2 over Zenoh, on a map."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import click

from factorbus.cli.output.exits import require
from factorbus.cli.output.logs import begin_logging, log_option
from factorbus.cli.process.children import READY
from factorbus.cli.process.options import DEFAULT_ENDPOINT, FOLDER, SECONDS, WholeNumber, grouped, zenoh_option
from factorbus.cli.process.parameters_file import NodeCommand, params_file_option
from factorbus.cli.process.robot_options import robot_options
from factorbus.ros2.options import BridgeOptions

DISTRIBUTIONS = ("humble", "jazzy", "kilted", "lyrical")
# The interpreter's default, 5 ms, is what a transform would wait for while a path is being drawn.
_SWITCH_S = 0.0005


@dataclass(frozen=True, slots=True)
class NodeOptions:
    """Our node in the robot's ROS graph: the router to join (None: as --connect), domain, distribution, its names.

    services: whether it has some.  save_folder: where what they save goes.
    """

    ros: str | None
    domain: int
    distro: str
    namespace: str
    node_name: str
    services: bool
    save_folder: Path | None


@click.command(cls=NodeCommand)
@grouped("as_node", NodeOptions)
@grouped("given", BridgeOptions)
@click.argument("map_name", metavar="MAP")
@click.option("--connect", "endpoint", default=DEFAULT_ENDPOINT, show_default=True, metavar="ENDPOINT", help="Ours.")
@click.option("--ros", metavar="ENDPOINT", help="The robot's Zenoh router (rmw_zenohd).  [default: as --connect]")
@click.option(
    "--domain", type=WholeNumber(0, 232), default=0, show_default=True, envvar="ROS_DOMAIN_ID", show_envvar=True
)
@click.option("--distro", type=click.Choice(DISTRIBUTIONS), default="jazzy", show_default=True, help="Of the robot.")
@click.option("--namespace", default="/", show_default=True, metavar="NAME", help="Of our node; topics are as given.")
@click.option("--node", "node_name", default="factorbus", show_default=True, metavar="NAME", help="Of our node.")
@robot_options(usual=True)
@click.option("--tf", default="/tf", show_default=True, metavar="TOPIC", help="Where map to odometry goes.")
@click.option(
    "--smooth-s", type=SECONDS, default=0.0, show_default=True, metavar="SECONDS",
    help="A correction moves that transform over this time, by odometry's stamps, and not at once.",
)  # fmt: skip
@click.option(
    "--tf-raw", default="/factorbus/tf_raw", show_default=True, metavar="TOPIC",
    help="Where it goes as the map has it, with --smooth-s.",
)  # fmt: skip
@click.option("--path", default="/factorbus/path", show_default=True, metavar="TOPIC", help="Where nav_msgs/Path goes.")
@click.option(
    "--markers", default="/factorbus/markers", show_default=True, metavar="TOPIC",
    help="Where visualization_msgs/MarkerArray goes.",
)  # fmt: skip
@click.option(
    "--pose-out", default="/factorbus/pose", show_default=True, metavar="TOPIC",
    help="Where geometry_msgs/PoseWithCovarianceStamped of the last keyframe goes.",
)  # fmt: skip
@click.option(
    "--tolerance", type=SECONDS, default=0.1, show_default=True, metavar="SECONDS", help="Transforms are stamped ahead."
)
@click.option(
    "--services/--no-services", default=True, show_default=True, help="settle, save, fork, repair, as Trigger."
)
@click.option("--save-folder", type=FOLDER, metavar="DIR", help="Where the service saves.")
@click.option(
    "--display", type=SECONDS, default=1.0, show_default=True, metavar="SECONDS", help="Least time between paths."
)
@params_file_option
@zenoh_option
@log_option
@click.option("--quiet", is_flag=True, help="Log warnings only.")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
def command(
    map_name: str,
    endpoint: str,
    as_node: NodeOptions,
    given: BridgeOptions,
    log_form: str,
    quiet: bool,
    until_eof: bool,
    zenoh: str,
) -> None:
    """Join a robot that speaks ROS 2 over Zenoh (rmw_zenoh) to MAP. No ROS is needed on this side.

    Reads odometry, poses with covariance, landmark detections, loop closures of a front end's graph, fixes of GNSS and
    samples of an IMU; publishes the transform from map to odometry after every step, a path and markers. Has services
    of the type std_srvs/Trigger: /factorbus/settle, save, fork, repair, accept and reject. Prints `ready` when the
    robot can begin. Until Ctrl-C.

    \b
    factorbus ros2 warehouse
    factorbus ros2 warehouse --ros tcp/robot1.local:7447 --domain 7 --odom /robot1/odom --letter a
    factorbus ros2 yard --space --landmarks /tags --mount camera=0.2,0,0.3,-0.5,0.5,-0.5,0.5
    factorbus ros2 yard --params-file robot1.yaml

    What is done with covariances, and more: deploy/ros2/README.md.
    """
    require("ros2", "factorbus ros2")
    from factorbus.cli.process.bus import open_bus
    from factorbus.cli.process.stopping import stop_when_asked
    from factorbus.ros2.bridge import Bridge
    from factorbus.ros2.messages import Messages
    from factorbus.ros2.node import open_node
    from factorbus.ros2.services import MapServices
    from factorbus.ros2.settings import bridge_settings

    begin_logging(log_form, quiet)
    settings, ros = bridge_settings(given), as_node.ros
    with (
        _switching_often(),
        stop_when_asked(until_eof) as stop,
        open_bus(endpoint, "ros2", zenoh) as bus,
        bus.map(map_name) as joined,
        open_node(
            ros or endpoint,
            as_node.domain,
            as_node.namespace,
            as_node.node_name,
            bus.timeout_s,
            {},
            zenoh if ros is None else "",
        ) as node,
    ):
        messages = Messages(as_node.distro)
        bridge = Bridge(joined, node, messages, settings)
        with ExitStack() as serving:
            if as_node.services:
                services = MapServices(bus, joined, as_node.save_folder, settings.letter)
                serving.enter_context(services.offer(node, messages))
            click.echo(f"{READY}{ros or endpoint}")
            bridge.run(stop)
        click.echo(" ".join(f"{name}={count}" for name, count in sorted(bridge.counts.items())), err=True)


@contextmanager
def _switching_often() -> Iterator[None]:
    """Threads take turns after _SWITCH_S."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield
    finally:
        sys.setswitchinterval(before)
