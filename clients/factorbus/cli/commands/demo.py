"""`factorbus demo`: a solver process, workers, a robot and a viewer, on the bus, on this machine."""

import importlib
import json
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.exits import output_file, require
from factorbus.cli.output.starts import NOT_CONVERGED, optimum_from
from factorbus.cli.process.options import WORLDS, WholeNumber, json_option, out_option
from factorbus.wording import counted

_COMPARISONS = 10
_LAST_DELTAS_S = 10.0  # they come after the robot has its last answer, if at all


@dataclass(frozen=True, slots=True)
class DemoRequest:
    """What the command line asked for."""

    world: str
    poses: int
    seed: int
    workers: int
    plot: Path
    tum: Path | None = None
    truth: Path | None = None


class _Demos(click.Group):
    """The demo, and others by name, imported when they are called."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return ["monocular"]

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.list_commands(ctx):
            return None
        return importlib.import_module(f"factorbus.cli.commands.demo_{cmd_name}").command


@click.group(cls=_Demos, invoke_without_command=True)
@click.option("--world", type=click.Choice(WORLDS), default="manhattan", show_default=True)
@click.option("--poses", type=WholeNumber(10, 1_000_000), default=2000, show_default=True, metavar="N")
@click.option("--seed", type=WholeNumber(0), default=1, show_default=True, help="The same seed, the same world.")
@click.option("--workers", type=WholeNumber(0, 64), default=2, show_default=True, metavar="N")
@out_option("--plot", "plot", "The picture.  [default: out/demo.png]", "FILE.png")
@out_option("--tum", "tum", "Write the estimated trajectory in TUM form.", "FILE")
@out_option("--truth", "truth", "Write where the robot really was, in TUM form.", "FILE")
@json_option
@click.pass_context
def command(ctx: click.Context, as_json: bool, plot: Path | None, **asked: Any) -> None:
    """Show it all: a simulated robot drives through a world it does not know and the map follows.

    Five processes on this machine, talking over Zenoh: the solver, two workers, the robot's front end, and this one,
    which looks on as a viewer. The robot inserts pose after pose; every step's estimate is published, and arrives
    here; ten times on the way a worker solves the whole map from scratch, to hold it against.

    \b
    factorbus demo
    factorbus demo --world sphere --poses 1000 --plot sphere.png
    factorbus demo --json
    factorbus demo --tum demo.tum --truth truth.tum; evo_ape tum truth.tum demo.tum
    factorbus demo monocular                    a camera, and rays that become points
    """
    if ctx.invoked_subcommand:
        return
    require("service", "factorbus demo")
    require("viz", "factorbus demo")
    from factorbus.cli.output import console as screen

    if plot is None:
        plot = Path("out") / "demo.png"
        plot.parent.mkdir(exist_ok=True)
    result = run_demo(DemoRequest(plot=plot, **asked))
    if as_json:
        screen.document(result)
    else:
        screen.table(_rows(result), title=f"{result['world']}, {counted(result['poses'], 'pose')}")


def run_demo(request: DemoRequest) -> dict[str, Any]:
    """Run it, with progress on standard error; returns the document."""
    from factorbus.cli.demo.ground_truth import World
    from factorbus.cli.driving.picture import draw, history_of
    from factorbus.cli.driving.remote import RemoteMap
    from factorbus.cli.output.console import print_note
    from factorbus.cli.process.children import STARTING, child, service, worker
    from factorbus.cli.process.stopping import interrupt_on_sigterm
    from factorbus.client import connect

    with ExitStack() as stack:
        stack.enter_context(interrupt_on_sigterm())
        print_note(STARTING)
        solver, endpoint = stack.enter_context(service(say=print_note))
        names = [f"worker{number}" for number in range(1, request.workers + 1)]
        workers = [stack.enter_context(worker(endpoint, name)) for name in names]
        bus = stack.enter_context(connect(endpoint, client="viewer"))
        viewer = RemoteMap(stack.enter_context(bus.map("demo")))
        stack.callback(viewer.close)
        world = ("--world", request.world, "--poses", str(request.poses), "--seed", str(request.seed))
        robot = stack.enter_context(
            child("robot", "robot", "--connect", endpoint, "--map", "demo", "--until-eof", *world)
        )
        processes = {"solver": solver.pid, "robot": robot.pid} | {
            name: w.pid for name, w in zip(names, workers, strict=True)
        }
        print_note(f"on {endpoint}: " + ", ".join(f"{name} {pid}" for name, pid in processes.items()))
        print_note(f"driving {counted(request.poses, 'pose')}; 2,000 take five to thirty seconds")
        _look_on(request, solver, robot, viewer)
        driven = json.loads(robot.output(timeout_s=60))
        viewer.wait_for(driven["revision"])
        viewer.compare()
        compared, seen = viewer.compared(), viewer.summary()
        estimate, reports = viewer.estimate(), viewer.reports
    world = World(request.world, request.poses, request.seed)
    result = {
        **driven,
        "world": request.world,
        "seed": request.seed,
        "chi2": compared[-1].chi2,
        "chi2_batch": compared[-1].batch,
        "batch_converged": compared[-1].batch_converged,
        "against_batch": [each.as_dict() for each in compared],
        **world.judge(estimate),
        "estimates_received": {"viewer": seen["deltas"], "robot": driven["deltas"]},
        "every_estimate_received": seen["deltas"] == driven["deltas"] == driven["revision"],
        "solver_cpu_s": seen["solver_cpu_s"],
        "kernels_compiled_s": seen["kernels_compiled_s"],
        "processes": processes,
        "plot": str(request.plot),
    }
    written = _write(request, estimate, world.truth)
    subtitle = (
        f"{counted(result['poses'], 'pose')}, χ² {result['chi2']:.6g}, {_metres(result['error_m'])} from the truth"
    )
    history = history_of(reports, compared)
    with output_file(request.plot):
        draw(
            request.plot, world.batches, estimate, history, f"{request.world}, as the bus saw it", subtitle, world.truth
        )
    return result | {"written": [*written, str(request.plot)]}


def _write(request: DemoRequest, estimate: Any, truth: Any) -> list[str]:
    """The trajectories that were asked for; says which is where."""
    from factorbus.cli.output.console import print_note
    from factorbus.formats import write_tum
    from factorbus.proto.messages import Batch

    asked = ((request.tum, estimate, "the estimated trajectory"), (request.truth, truth, "where the robot really was"))
    files = list[str]()
    for path, variables, what in asked:
        if path:
            with output_file(path):
                files += map(str, write_tum(path, Batch(tuple(variables))))
            print_note(f"{path}: {what}, written")
    return files


def _look_on(request: DemoRequest, solver: Any, robot: Any, viewer: Any) -> None:
    """Show how far the robot is, from what arrives here, and have the map compared now and then.  Raises Stopped."""
    from factorbus.cli.output.console import progress

    every, asked = max(request.poses // _COMPARISONS, 1), 0
    with progress("the robot drives", request.poses) as show:
        while not robot.ended():
            if solver.ended():
                raise solver.died()
            revision = viewer.wait_for_delta(timeout_s=0.2)
            show(revision, _word(viewer))
            if revision // every > asked and revision < request.poses:
                asked = revision // every
                viewer.compare()
        # The last deltas may come after the robot has its answers.
        end = time.monotonic() + _LAST_DELTAS_S
        while (revision := viewer.wait_for_delta(timeout_s=0.2)) < request.poses and time.monotonic() < end:
            show(revision, _word(viewer))
        show(revision, _word(viewer))


def _word(viewer: Any) -> str:
    latest = viewer.latest
    return f"χ² {latest['chi2']:.6g}, step {latest['step_ms']:.1f} ms" if latest else ""


def _rows(result: dict[str, Any]) -> list[tuple[str, str]]:
    ratios = [each["ratio"] for each in result["against_batch"]]
    last = result["against_batch"][-1]
    found = optimum_from(last["start"], converged=last["batch_converged"])
    by = f"{found}; {last['worker']}, {last['seconds'] * 1e3:.0f} ms"
    rows = [
        (
            "poses",
            f"{result['poses']:,}"
            + (f", and {counted(result['landmarks'], 'landmark')}" if result["landmarks"] else ""),
        ),
        ("factors", f"{result['factors']:,}, {counted(result['loop_closures'], 'loop closure')} among them"),
        ("speed", f"{result['poses_per_s']:.0f} poses/s, {result['seconds']:.1f} s in all"),
        ("step in the solver", _times(result["step_ms"])),
        ("bus, beyond the solver", _times(result["bus_ms"])),
        ("χ²", f"{result['chi2']:.8g}; {result['chi2_initial']:.4g} by odometry alone"),
        (
            "χ² / batch optimum",
            f"{last['ratio']:.9f} at the end ({by}), at worst {max(ratios):.9f} of {counted(len(ratios), 'time')}",
        ),
        (
            "error against the truth",
            f"{_metres(result['error_m'])}; by odometry alone {_metres(result['error_odometry_m'])}",
        ),
    ]
    if ended := sum(not each["batch_converged"] for each in result["against_batch"]):
        rows.append(("batch optimum", f"{counted(ended, 'time')} {NOT_CONVERGED}"))
    if worse := sum(each["better_optimum"] for each in result["against_batch"]):
        rows.append(("better_optimum", f"the map was above it by more than 1 % {counted(worse, 'time')}"))
    if result["error_landmarks_m"]:
        rows.append(("landmarks' error", _metres(result["error_landmarks_m"])))
    rows += [("estimates received", _received(result)), ("picture", result["plot"])]
    return rows


def _received(result: dict[str, Any]) -> str:
    """How many steps' deltas came to whom; the rest came inside a whole estimate."""
    got = result["estimates_received"]
    told = f"{counted(result['steps'], 'step')}, {got['robot']:,} by the robot, {got['viewer']:,} by the viewer"
    if result["every_estimate_received"]:
        return f"every one: {told}"
    return (
        f"{told}; where a step's delta came late, as on a busy machine, the whole estimate was fetched, "
        "so every copy is complete at the end"
    )


def _times(times: dict[str, float]) -> str:
    return f"p50 {times['p50']:.2f}   p99 {times['p99']:.2f}   max {times['max']:.2f} ms"


def _metres(spread: dict[str, float]) -> str:
    return f"{spread['rms']:.3g} m rms, {spread['max']:.3g} m at most"
