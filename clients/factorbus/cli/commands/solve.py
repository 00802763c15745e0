"""`factorbus solve`: a whole graph at its optimum, without a map."""

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from factorbus.cli.driving.solving import SolveRequest
from factorbus.cli.output.exits import FAILED, OK, require
from factorbus.cli.process.options import (
    Number,
    WholeNumber,
    checked_output,
    file_argument,
    grouped,
    json_option,
    out_option,
)
from factorbus.cli.process.reading import reading_options
from factorbus.proto.kinds import LOSSES
from factorbus.proto.problems import BadSymbol
from factorbus.proto.symbols import parse_symbol

_STARTS = ("best", "odometry", "file", "rotations")


class _Loss(click.ParamType):
    """NAME or NAME:SCALE, as (name, scale)."""

    name = "loss"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, float]:
        if isinstance(value, tuple):
            return value
        loss, _, scale = str(value).partition(":")
        if loss not in LOSSES:
            self.fail(
                f"there is no loss {loss!r}; wanted one of {', '.join(LOSSES)}, and a scale: huber:1.0", param, ctx
            )
        return loss, Number(0, min_open=True).convert(scale or "1.0", param, ctx)


def _covariance(ctx: click.Context, parameter: click.Parameter, text: str | None) -> Path | tuple[int, ...] | None:
    """A file to write, or keys."""
    if text is None:
        return None
    if text.endswith(".csv"):
        return checked_output(ctx, parameter, Path(text))
    try:
        return tuple(parse_symbol(each.strip()) for each in text.split(","))
    except BadSymbol as problem:
        raise click.BadParameter(f"{problem}; or a file, FILE.csv", param=parameter) from problem


@click.command()
@grouped("request", SolveRequest)
@file_argument("file")
@out_option(
    "--out",
    "out",
    "Write the graph at its optimum, or the trajectory, in the form of the ending.",
    "FILE.g2o|.pyfg|.jrl|.cbor|.tum|.kitti",
)
@click.option(
    "--start",
    type=click.Choice(_STARTS),
    default="best",
    show_default=True,
    help="Where to begin: composed odometry, the file's values, averaged rotations, or whichever of them ends lowest.",
)
@click.option("--loss", type=_Loss(), metavar="NAME:SCALE", help="Robust loss of all factors that close loops.")
@click.option(
    "--gnc",
    is_flag=True,
    help="Find the false ones among these by graduated non-convexity; leave them out. Priors are trusted.",
)
@click.option(
    "--probability",
    type=Number(0, 1, min_open=True, max_open=True),
    default=0.99,
    show_default=True,
    help="With --gnc: with which a right measurement is kept.",
)
@click.option(
    "--covariance",
    callback=_covariance,
    metavar="KEYS|FILE.csv",
    help="Covariance of x5,l3,... at the optimum; or of all variables, into a file. Rows are in the order of "
    "`factorbus ask covariance`: x y theta, or x y z rx ry rz (m, rad).",
)
@click.option("--max-iterations", type=WholeNumber(1), default=500, show_default=True, help="Of one start.")
@click.option("--cores", type=WholeNumber(1), metavar="N", help="Use N of them.  [default: all there are]")
@reading_options
@json_option
def command(request: SolveRequest, as_json: bool) -> int:
    """Optimize the graph in FILE (any that `factorbus replay` reads, or a data set's name) and be done: no map, no bus.

    Levenberg-Marquardt with block Cholesky; a variable without a value gets one from its factors. How much memory it
    takes is said before, and a graph that needs more than there is is refused. With the extra `metis` graphs of 50,000
    poses and more take a half to an eighth of the time, and less memory.

    \b
    factorbus solve w10000.g2o --out optimum.g2o
    factorbus solve sphere2500 --start rotations --covariance x10,x2000
    factorbus solve lab.g2o --gnc --out lab.tum
    factorbus solve lab.g2o --loss huber:1.0 --covariance sigmas.csv --json

    \b
    In the result:
      starts       χ² of each start;  start: the one whose end is lowest
      chi2         Σ rᵀ Ω r at the end, of a factor with a loss ρ(rᵀ Ω r)
      gnc          suspects: factors that were looked at;  false: those left out;  trusted: those of one variable, as
                   priors and positions, which are not looked at: a false one pulls the map, or makes others false
      left         what one more Gauss-Newton step would take off it, predicted
      seconds      search: from the graph in memory to the optimum in memory, loading the solver's kernels included
    The exit code is 1 where the search has ended before it had converged.
    """
    given = click.get_current_context().get_parameter_source("probability")
    if given is ParameterSource.COMMANDLINE and not request.gnc:
        raise click.UsageError("--probability is of --gnc, which looks for false factors; give both, or neither")
    require("service", "factorbus solve")
    from factorbus.cli.driving.solving import run_solve, solution_rows
    from factorbus.cli.output import console as screen

    result = run_solve(request)
    if as_json:
        screen.document(result)
    else:
        screen.table(solution_rows(result), title=str(request.file))
    return OK if result["converged"] else FAILED
