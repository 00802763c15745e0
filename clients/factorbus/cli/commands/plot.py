"""`factorbus plot`: pictures of maps, drives and systems, from files and from the bus."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import click

from factorbus.cli.output.exits import output_file, require
from factorbus.cli.process.options import (
    WholeNumber,
    ellipses_option,
    json_option,
    mode_option,
    out_option,
    zenoh_option,
)
from factorbus.cli.process.reading import reading_options
from factorbus.wording import counted

F = TypeVar("F", bound=Callable[..., Any])

_FROM_BUS = "SOURCE is a map of the service at ENDPOINT."


@click.group()
def command() -> None:
    """Draw into a .png, .svg or .pdf file, in colours that colour-blind readers can tell apart.

    SOURCE is a graph file (g2o, TORO, iSAM, SLAM++, pyfg, JRL), a map of GLIM's, the name of a data set, or with
    --connect the name of a map on the bus. What of a file is left out is said.

    \b
    factorbus plot map town.g2o --solve
    factorbus plot map warehouse --connect tcp/127.0.0.1:7447 --out warehouse.svg
    factorbus plot drive town.g2o
    factorbus plot sparsity town.g2o
    factorbus plot tree town.g2o
    """


def _source(command: F) -> F:
    return click.argument("source")(
        click.option("--connect", metavar="ENDPOINT", help=_FROM_BUS)(zenoh_option(reading_options(command)))
    )


@dataclass(frozen=True, slots=True)
class _Picture:
    """The file that was asked for, if one was, and how it is said where the picture is."""

    path: Path | None
    as_json: bool

    def say(self, path: Path) -> None:
        from factorbus.cli.output.console import document

        if self.as_json:
            document({"files": [str(path)]})
        else:
            click.echo(path)


def _out(what: str) -> Callable[[F], F]:
    """--out and --json, as the argument `out`."""
    option = out_option("--out", "path", f"The picture.  [default: SOURCE-{what}.png here]", "FILE.png")

    def with_options(command: F) -> F:
        @wraps(command)
        def run(path: Path | None, as_json: bool, **options: Any) -> Any:
            return command(out=_Picture(path, as_json), **options)

        return option(json_option(run))  # type: ignore[return-value]

    return with_options


@command.command("map")
@_source
@click.option("--solve", is_flag=True, help="Draw the optimum of the graph, found here, instead of the file's values.")
@ellipses_option(0)
@_out("map")
def map_command(
    source: str,
    connect: str | None,
    zenoh: str,
    dialect: str | None,
    strict: bool,
    solve: bool,
    ellipses: int,
    out: _Picture,
) -> None:
    """Trajectory, landmarks, loop closures, where odometry alone would have led, and the ground truth of a .jrl, moved
    as one rigid body to where it fits the trajectory best.

    \b
    factorbus plot map intel --solve --out intel.pdf
    factorbus plot map victoria_park --solve --ellipses 60
    factorbus plot map warehouse --connect tcp/127.0.0.1:7447 --ellipses 60
    """
    from factorbus.cli.driving.aligned_truth import aligned_truth
    from factorbus.cli.driving.picture import draw
    from factorbus.cli.driving.plot_source import graph_of, solved, spread_in, with_values
    from factorbus.client.roles import of_the_map
    from factorbus.viz import DriveHistory

    drawn = _ready(lambda: graph_of(source, connect, zenoh, dialect, strict))
    drawn = solved(drawn, on_file=connect is None) if solve else with_values(drawn)
    path = drawn.file("map", out.path)
    estimate = of_the_map(drawn.graph)  # what is on a robot, or another frame, is drawn nowhere
    placed = replace(drawn, graph=drawn.graph._replace(variables=estimate))
    spread = spread_in(placed, connect, ellipses, zenoh) if ellipses else None
    truth = aligned_truth(drawn.truth, estimate)
    with output_file(path):
        draw(path, [drawn.unsolved()], estimate, DriveHistory(), drawn.name, drawn.about, truth, spread)
    out.say(path)


@command.command("drive")
@click.argument("source")
@reading_options
@mode_option
@click.option(
    "--every",
    type=WholeNumber(0),
    metavar="N",
    help="Solve from scratch at every Nth step, to hold χ² against.  [default: ten times]",
)
@_out("drive")
def drive_command(source: str, dialect: str | None, strict: bool, mode: str, every: int | None, out: _Picture) -> None:
    """Drive SOURCE through a map in this process: χ² beside the batch optimum, and the time of each step.

    \b
    factorbus plot drive intel --mode bayes-tree --out intel-drive.svg
    """
    from factorbus.cli.driving.plot_source import file_named

    require("service", "factorbus plot drive")
    file = _ready(lambda: file_named(source, dialect, strict))
    from factorbus.cli.driving.drive import insert_steps
    from factorbus.cli.driving.local import LocalMap
    from factorbus.cli.driving.picture import history_of
    from factorbus.cli.output.console import progress
    from factorbus.solver import warm
    from factorbus.viz import drive_figure

    warm()  # so that the first steps do not load kernels
    target = LocalMap(mode)
    with progress(Path(file.path).name, file.poses) as show:
        driven = insert_steps(target, file.steps(), max(file.poses // 10, 1) if every is None else every, show)
    reports = [step.report for step in driven.steps]
    name = Path(file.path).stem
    path = out.path or Path(f"{name}-drive.png")
    about = f"{counted(driven.poses, 'pose')}, {counted(driven.factors, 'factor')}, mode {reports[-1]['mode']}"
    figure = drive_figure(
        history_of(reports, target.compared()), [report["strategy"] for report in reports], name, about
    )
    _save(figure, path, name)
    out.say(path)


@command.command("sparsity")
@_source
@_out("sparsity")
def sparsity_command(
    source: str, connect: str | None, zenoh: str, dialect: str | None, strict: bool, out: _Picture
) -> None:
    """Λ in the order of keys, Λ in the order of elimination, and the fill-in of its factor R.

    \b
    factorbus plot sparsity intel
    """
    from factorbus.cli.driving.plot_source import graph_of

    require("service", "factorbus plot sparsity")
    drawn = _ready(lambda: graph_of(source, connect, zenoh, dialect, strict))
    from factorbus.cli.output.sparsity import pattern_of
    from factorbus.viz import sparsity_figure

    path = drawn.file("sparsity", out.path)
    _save(sparsity_figure(pattern_of(drawn.graph), drawn.name), path, drawn.name)
    out.say(path)


@command.command("tree")
@_source
@_out("tree")
def tree_command(
    source: str, connect: str | None, zenoh: str, dialect: str | None, strict: bool, out: _Picture
) -> None:
    """The elimination tree of Λ, and what of it the last loop closure makes anew.

    \b
    factorbus plot tree intel
    """
    from factorbus.cli.driving.plot_source import graph_of

    require("service", "factorbus plot tree")
    drawn = _ready(lambda: graph_of(source, connect, zenoh, dialect, strict))
    from factorbus.cli.output.sparsity import last_loop, pattern_of
    from factorbus.viz import tree_figure

    path = drawn.file("tree", out.path)
    pattern = pattern_of(drawn.graph)
    _save(tree_figure(pattern, last_loop(drawn.graph, pattern), drawn.name), path, drawn.name)
    out.say(path)


def _ready(load: Callable[[], Any]) -> Any:
    """What `load` gives, once it is known that a picture can be drawn."""
    require("viz", "factorbus plot")
    return load()


def _save(figure: Any, path: Path, name: str) -> None:
    """The picture in its file."""
    from factorbus.viz import save

    with output_file(path):
        save(figure, path, name)
