"""`factorbus replay`: a graph file or a data set through a map, pose by pose, as a robot would have sent it."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import click

from factorbus.cli.driving.replay_files import AskedFiles, ReplayedDrive, write_files
from factorbus.cli.driving.replay_reading import check_kind, read_steps
from factorbus.cli.driving.replay_source import source_of
from factorbus.cli.driving.replay_table import replay_rows
from factorbus.cli.output.exits import REFUSED, Stopped, missing_modules, require
from factorbus.cli.output.starts import optimum_from
from factorbus.cli.process.options import (
    PAGE_HOST,
    SECONDS,
    Number,
    WholeNumber,
    file_argument,
    grouped,
    json_option,
    mode_option,
    out_option,
    zenoh_option,
)
from factorbus.cli.process.parameters_file import NodeCommand, params_file_option
from factorbus.cli.process.reading import reading_options, told_of
from factorbus.cli.process.robot_options import robot_options
from factorbus.proto.ports import check_free
from factorbus.ros2.options import RobotOptions

_ANSWER_S, _LISTENING_S = 10.0, 0.6


@dataclass(frozen=True, slots=True)
class ReplayRequest:
    """What the command line asked for."""

    file: Path
    in_process: bool
    connect: str | None
    timeout_s: float | None
    map_name: str
    mode: str
    every: int
    window: int
    use_values: bool
    settle: bool
    adopt: bool
    tum: Path | None
    kitti: Path | None
    out: Path | None
    plot: Path | None
    client: str = "replay"
    zenoh: str = ""
    live: bool = False
    port: int = 8080
    pace: float | None = None
    dialect: str | None = None
    strict: bool = False
    robot: RobotOptions | None = None
    rate: float | None = None
    closures: str | None = None

    @property
    def where(self) -> str:
        """In words."""
        if self.in_process:
            return "this process"
        return f"map {self.map_name} at {self.connect}" if self.connect else "a solver process of its own"


class RecordingCommand(NodeCommand):
    """Drives what `factorbus ros2` would have heard: of its parameters file the options about the robot are read."""

    def parameters(self) -> dict[str, click.Parameter | None]:
        """Those of the node; the ones about the robot are options here, too, and have an effect."""
        from factorbus.cli.commands.ros2 import command as node

        mine, robot = super().parameters(), {each.name for each in fields(RobotOptions)}
        return {
            name: mine[name] if option is not None and option.name in robot else None
            for name, option in node.parameters().items()
        }


@click.command(cls=RecordingCommand)
@grouped("robot", RobotOptions)
@file_argument("file")
@click.option("--in-process", is_flag=True, help="Run the solver in this process, without a bus.")
@click.option("--connect", metavar="ENDPOINT", help="Use the service at ENDPOINT instead of starting one.")
@zenoh_option
@click.option(
    "--client", default="replay", show_default=True, metavar="NAME", help="Who we are, where access control asks."
)
@click.option(
    "--timeout",
    "timeout_s",
    type=SECONDS,
    metavar="S",
    help="Give up after S seconds without an answer of the service.  [default: 1 where nobody listens, else 10]",
)
@click.option("--map", "map_name", default="replay", show_default=True, metavar="NAME", help="Map to drive into.")
@mode_option
@click.option(
    "--closures",
    type=click.Choice(("trust", "test", "robust")),
    help="Believe the file's loop closures, test each as it comes, or weigh them (graduated non-convexity).",
)
@click.option(
    "--every",
    type=WholeNumber(0),
    default=0,
    metavar="N",
    help="Hold χ² against the batch optimum at every Nth step; 0: never.",
)
@click.option("--window", type=WholeNumber(1), default=1, show_default=True, metavar="N", help="Inserts in flight.")
@click.option("--use-values", is_flag=True, help="Start from the file's vertex values, not from composed odometry.")
@click.option("--settle/--no-settle", default=True, show_default=True, help="At the end, iterate until converged.")
@click.option(
    "--adopt/--no-adopt",
    default=True,
    show_default=True,
    help="With --settle: go to the optimum found from scratch where that is better by more than 1 %.",
)
@click.option("--live", is_flag=True, help="Show the map in a browser as it grows; afterwards stay until Ctrl-C.")
@click.option(
    "--port", type=WholeNumber(0, 65535), default=8080, show_default=True, help="Of the page with --live; 0: any."
)
@click.option("--pace", type=Number(0, min_open=True), metavar="HZ", help="Inserts a second, at most.")
@click.option(
    "--rate", type=Number(0, min_open=True), metavar="X", help="A recording in its own time, X times as fast."
)
@out_option("--tum", "tum", "Write the trajectory in TUM form (evo reads it).", "FILE")
@out_option("--kitti", "kitti", "Write the trajectory in KITTI form.", "FILE")
@out_option("--out", "out", "Write the estimate and the factors, by the ending.", "FILE.g2o|.pyfg|.jrl|.cbor")
@out_option("--plot", "plot", "Draw odometry, estimate and loop closures.", "FILE.png")
@reading_options
@robot_options(usual=False)
@params_file_option
@json_option
def command(as_json: bool, **asked: Any) -> None:
    """Drive FILE (g2o, TORO, iSAM, SLAM++, PyFactorGraph, JRL, BAL, or a data set's name) through a map, pose by pose.
    Or the folder of a map that GLIM has saved, or one with a log of an IMU and GNSS, odometry or poses (EuRoC's mav0,
    KITTI raw, GTSAM's KITTI).

    Each step is one insert: a new pose, its odometry edge, and its edges to what is already there. The estimate is
    there after every step. What FILE fixes holds the map in place, or its priors; without either the pose of the lowest
    key is held. Without --in-process or --connect it starts a solver process and talks to it over the bus.

    FILE may be a robot's recording, too: an MCAP file or a rosbag2 folder of ROS 2, or a bag of ROS 1. It is driven as
    `factorbus ros2` would have sent it; the options from --odom on are of recordings.

    \b
    factorbus replay intel
    factorbus replay drive.mcap --plot drive.png
    factorbus replay drive.mcap --odom /wheel/odom --landmarks /tags --rate 1 --live
    factorbus replay intel.g2o --every 100 --plot intel.png
    factorbus replay intel.g2o --live --pace 100
    factorbus replay intel.g2o --connect tcp/127.0.0.1:7447 --map lab --tum lab.tum
    factorbus replay intel.g2o --in-process --json

    \b
    In the result, per insert or step:
      step_ms      the step in the solver
      bus_ms       from sending the insert to having its answer and its delta here, beyond the solver's own time
                   (staging and step); with --window above 1, from sending to the answer, queueing included
      chi2         Σ rᵀ Ω r at the end; chi2_initial: of composed odometry, before any step (null with an IMU)
      against_batch  χ² over that of the optimum found from scratch, and what led to it (start): the map's own values
                   (with --use-values the file's), composed odometry or averaged rotations, whichever ends lowest;
                   batch_converged false: its search ended before it had converged, the true optimum may be lower
      error_m      of a .jrl with ground truth: how far the poses are from it, which is first moved as one rigid body
                   to where it fits the estimate best (rms, max, and of how many poses)
      closure_states  of a map that tests them: how many closures are in each state at the end; else null
      adopted      null, or what the map left for a better optimum at the end (better_optimum)
    """
    request = ReplayRequest(**asked)
    check_kind(request.file)
    if request.in_process and request.connect:
        raise click.UsageError("--in-process and --connect exclude each other: the solver is here or it is there")
    if request.in_process and request.closures in ("test", "robust"):
        name = request.closures
        raise click.UsageError(f"--in-process and --closures {name} exclude each other: a map on the bus does that")
    if request.in_process and request.live:
        raise click.UsageError("--in-process and --live exclude each other: the page looks at a map on the bus")
    from factorbus.cli.output import console as screen

    def report(result: dict[str, Any]) -> None:
        if as_json:
            screen.document(result)
        else:
            screen.table(replay_rows(result), title=f"{request.file}, in {request.where}")

    replay(request, report)


def replay(request: ReplayRequest, report: Callable[[dict[str, Any]], None] = lambda _: None) -> dict[str, Any]:
    """Do it, with progress on standard error; returns the document, and hands it to `report` while the map is there."""
    from factorbus.cli.driving.aligned_truth import aligned_error_m
    from factorbus.cli.driving.drive import insert_steps
    from factorbus.cli.output import console as screen

    if request.plot:
        require("viz", "--plot")
    if request.live:
        require("gateway", "--live")
        check_free(f"{PAGE_HOST}:{request.port}", PAGE_HOST, request.port)
    request = replace(request, file=source_of(request.file))
    graph, steps = read_steps(request.file, request.robot, request.dialect, request.strict, request.use_values)
    with _target(request) as target:
        before = target.summary()
        with screen.progress(request.file.name, steps.poses) as show:
            driven = insert_steps(target, _paced(steps, request.pace, request.rate), request.every, show)
        unsettled = target.chi2()
        last = target.settle() if request.settle else driven.steps[-1]
        adopted = None
        if request.settle and request.adopt:
            last, adopted = _adopt(request, target, last)
        asked = AskedFiles(request.out, request.tum, request.kitti, request.plot, request.strict)
        truth = graph.log.ground_truth if graph.log else ()
        written, notes = write_files(asked, request.file.name, ReplayedDrive(target, graph, steps, driven, truth))
        result = _document(request, driven, target, steps, last, unsettled, before)
        result |= {"read": graph.summary(), "written": [str(file) for file in written], **told_of(notes)}
        result |= {"adopted": adopted}
        result |= {"error_m": aligned_error_m(truth, target.estimate())} if truth else {}
        report(result)
        if request.live:
            _stay()
    return result


def _adopt(request: ReplayRequest, target: Any, last: Any) -> tuple[Any, dict[str, Any] | None]:
    """The optimum found from scratch, if it is better than where the map has settled; says so."""
    from factorbus.cli.output.console import print_note

    found = target.optimum()
    if found.notice is None:
        return last, None
    last = target.adopt(found)
    told = f"better_optimum: χ² {found.chi2:.6g} where the map had settled; it is now at the"
    there = optimum_from(found.start, request.use_values, found.batch_converged)
    print_note(f"{told} {there}; χ² {last.report['chi2']:.6g}")
    return last, {"code": found.notice.code, **found.as_dict(), "chi2_adopted": last.report["chi2"]}


def _document(
    request: ReplayRequest, driven: Any, target: Any, steps: Any, last: Any, unsettled: float, before: Any
) -> dict[str, Any]:
    """What was measured."""
    measured, after = driven.measures(), target.summary()
    return {
        "file": str(request.file),
        "where": request.where,
        **measured,
        "revision": last.revision,
        "chi2": last.report["chi2"] if request.settle else unsettled,
        "chi2_unsettled": unsettled,
        "chi2_initial": _chi2_initial(steps),
        "fixed": _fixed(steps),
        "settled": bool(request.settle and last.report["converged"]),
        "settle_iterations": last.report["iterations"] if request.settle else 0,
        "solver_cpu_s": after["solver_cpu_s"] - before["solver_cpu_s"],
        "kernels_compiled_s": after["kernels_compiled_s"],
        "deltas": after["deltas"],
        "closure_states": after["closure_states"],
        "use_values": request.use_values,
        "against_batch": [each.as_dict() for each in target.compared()],
    }


@contextmanager
def _target(request: ReplayRequest) -> Iterator[Any]:
    """The map to drive into: here, in a service of our own, or in one that runs."""
    if request.in_process:
        require("service", "factorbus replay --in-process")
        from factorbus.cli.driving.local import LocalMap

        yield LocalMap(request.mode)
        return
    from factorbus.cli.driving.remote import RemoteMap
    from factorbus.cli.output.console import print_note
    from factorbus.cli.process.children import gateway, service, worker
    from factorbus.cli.process.stopping import interrupt_on_sigterm
    from factorbus.client import connect

    with ExitStack() as stack:
        stack.enter_context(interrupt_on_sigterm())
        endpoint, solver = request.connect, None
        if endpoint is None:
            require("service", "factorbus replay without --connect")
            solver, endpoint = stack.enter_context(service(say=print_note))
            print_note(f"solver process {solver.pid} on {endpoint}")
            if request.every:
                stack.enter_context(worker(endpoint, "worker1"))
        bus = stack.enter_context(
            connect(
                endpoint,
                client=request.client,
                zenoh=request.zenoh,
                timeout_s=_ANSWER_S if request.timeout_s is None else request.timeout_s,
                listening_s=_LISTENING_S if request.timeout_s is None else None,
            )
        )
        if solver is not None:
            solver.when_ended(bus.close)
        how = {"mode": request.mode, "window": request.window, "closures": request.closures}
        joined = stack.enter_context(bus.map(request.map_name, **how))
        if joined.estimate.revision > 0:
            raise Stopped(
                "map_not_empty",
                f"map {request.map_name!r} is at revision {joined.estimate.revision} already; "
                "a replay needs an empty one: give another --map",
                REFUSED,
                map=request.map_name,
            )
        if request.live:
            page = stack.enter_context(gateway(endpoint, request.port, request.zenoh, request.client))
            print_note(f"the map, live: {page}/#{request.map_name}")
        target = RemoteMap(joined, request.window)
        stack.callback(target.close)
        yield target


def _paced(steps: Any, pace_hz: float | None, rate: float | None) -> Iterator[Any]:
    """The same steps, at most `pace_hz` a second, or in the time of the recording, `rate` times as fast."""
    begun = time.monotonic()
    for number, step in enumerate(steps):
        due = number / pace_hz if pace_hz is not None else 0.0
        if rate is not None:
            due = max(due, 1e-9 * (steps.times_ns[number] - steps.times_ns[0]) / rate)
        if due:
            time.sleep(max(0.0, begun + due - time.monotonic()))  # the pace that was asked for
        yield step


def _stay() -> None:
    """Until Ctrl-C or SIGTERM."""
    from factorbus.cli.output.console import print_note
    from factorbus.cli.process.stopping import stop_when_asked

    with stop_when_asked(until_eof=False) as stop:
        print_note("the page stays until Ctrl-C")
        stop.wait()


def _fixed(steps: Any) -> list[str]:
    """The variables that the map is held by."""
    from factorbus.proto.symbols import format_symbol

    groups = [group for batch in steps for group in batch.variables if group.fixed]
    return [format_symbol(key) for group in groups for key in group.keys.tolist()]


def _chi2_initial(steps: Any) -> float | None:
    """χ² before any step, by the solver; None without one, and with an IMU, whose velocities are not odometry's."""
    if missing_modules("service") or any(group.kind.startswith("imu") for step in steps for group in step.factors):
        return None
    from factorbus.cli.driving.local import chi2_unsolved

    return chi2_unsolved(steps)
