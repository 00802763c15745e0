"""`factorbus ask`: what a map on the bus says of its certainty, of a measurement, and of itself."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import click

from factorbus.cli.commands.components import components_command
from factorbus.cli.commands.covariance import covariance_command
from factorbus.cli.commands.suspects import suspects_command
from factorbus.cli.output.advice import advising, of_what_is_there
from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import FAILED, OK, input_file
from factorbus.cli.output.starts import NOT_CONVERGED, optimum_from, ratio_to
from factorbus.cli.process.options import MapAddress, Number, asks_map, file_argument
from factorbus.cli.process.reading import read_graph, reading_options

_SHOWN = 20  # more false factors than these are listed with --json only

F = TypeVar("F", bound=Callable[..., Any])


@click.group()
def command() -> None:
    """Ask the map NAME on the bus. Answers are from one revision, and name it.

    \b
    factorbus ask covariance warehouse x12 x300
    factorbus ask gate warehouse candidates.g2o
    factorbus ask why warehouse x12
    factorbus ask chi2 warehouse --batch
    """


_probability = click.option(
    "--probability",
    type=Number(0, 1, min_open=True, max_open=True),
    default=0.95,
    show_default=True,
    help="With which a right measurement passes.",
)


@command.command("gate")
@asks_map
@file_argument("candidates")
@reading_options
@_probability
def gate_command(
    address: MapAddress, candidates: Path, dialect: str | None, strict: bool, probability: float, as_json: bool
) -> int:
    """Whether the factors in the file CANDIDATES are plausible; the exit code is 1 when one is not.

    The file is g2o, TORO, iSAM, SLAM++, PyFactorGraph or JRL text. Its keys are those of the map; its vertices are not
    looked at.
    A file without a factor that can be read is refused (3); with --strict, so is one of which anything is left out.

    \b
    factorbus ask gate warehouse candidates.g2o --probability 0.99
    """
    read = _read(candidates, dialect, strict)
    factors = read.batch.factors
    with _map(address) as joined:
        found = joined.uncertainty.ask.gate(factors, probability, address.timeout_s).result()
    columns = (found.distance.tolist(), found.threshold.tolist(), found.plausible.tolist())
    rows = [
        {"factor": told, "distance": distance, "threshold": allowed, "plausible": plausible}
        for told, distance, allowed, plausible in zip(_described(factors), *columns, strict=True)
    ]
    if as_json:
        document({"revision": found.revision, "read": read.summary(), "candidates": rows})
    else:
        table(
            [
                (row["factor"], f"d² {row['distance']:.4g} of {row['threshold']:.4g}: {_word(row['plausible'])}")
                for row in rows
            ],
            title=f"At revision {found.revision}",
        )
    return OK if all(row["plausible"] for row in rows) else FAILED


@command.command("gain")
@asks_map
@file_argument("candidates")
@reading_options
def gain_command(address: MapAddress, candidates: Path, dialect: str | None, strict: bool, as_json: bool) -> int:
    """How much information each of the factors in the file CANDIDATES would bring by itself, in nats, the most first.

    \b
    factorbus ask gain warehouse candidates.g2o
    """
    read = _read(candidates, dialect, strict)
    factors = read.batch.factors
    with _map(address) as joined:
        found = joined.uncertainty.ask.gain(factors, address.timeout_s).result()
    rows = sorted(zip(_described(factors), found.gain.tolist(), strict=True), key=lambda row: -row[1])
    if as_json:
        content = [{"factor": told, "gain": gain} for told, gain in rows]
        document({"revision": found.revision, "read": read.summary(), "candidates": content})
    else:
        table([(told, f"{gain:.4g}") for told, gain in rows], title=f"Nats at revision {found.revision}")
    return OK


@command.command("why")
@asks_map
@click.argument("what")
@click.option("--variable", is_flag=True, help="WHAT is a variable: of a key without a letter, 7.")
@click.option("--factor", is_flag=True, help="WHAT is the id of a factor.")
def why_command(address: MapAddress, what: str, variable: bool, factor: bool, as_json: bool) -> int:
    """What holds the variable WHAT (x12), or what the factor with the id WHAT (17) does; why the last step was made so.

    Residuals and χ² are at the estimate. The leverage of a factor is the trace of its part of the hat matrix,
    tr(Ω H Σ Hᵀ), from 0 (the others determine what it measures) to the dimension of its residual (it alone does). The
    pivots of a variable are those of the Cholesky factor R, and Λ is the information matrix: R²ᵢᵢ/Λᵢᵢ is 1 where no
    variable that was eliminated before depends on it, and near 0 where its estimate rests on those.

    By how much χ² falls without a factor is given to first order, "about", and is never more than all of χ².

    A number is the factor with this id, and where the map has a variable whose key is that number without a letter,
    both are shown, unless --variable or --factor says which is meant.

    \b
    factorbus ask why warehouse x12
    factorbus ask why warehouse 17 --json
    factorbus ask why warehouse 7 --variable
    """
    if variable and factor:
        raise click.UsageError("--variable and --factor exclude each other")
    only = "variable" if variable else "factor" if factor else None
    if only == "factor" and not what.isdecimal():
        raise click.UsageError(f"--factor wants an id, a whole number; {what!r} is the key of a variable")
    with _map(address) as joined:
        told = _explanations(joined, what, only)
    if as_json:
        content = {"revision": told[0].revision, "variable": {}, "factor": {}, "step": told[0].step}
        for found in told:
            content |= {kind: explained for kind in ("variable", "factor") if (explained := getattr(found, kind))}
        document(content)
        return OK
    for found in told:
        _tell(what, found)
    return OK


def _explanations(joined: Any, what: str, only: str | None) -> list[Any]:
    """Of the variable, of the factor, or of both where WHAT may be either.  Raises Refused."""
    from factorbus.client import Refused

    if not what.isdecimal() or only == "variable":
        return [joined.uncertainty.why(what)]
    if only == "factor":
        return [joined.uncertainty.why(factor=int(what))]
    told, refused = [], None
    for how in ({"key": what}, {"factor": int(what)}):
        try:
            told.append(joined.uncertainty.why(**how))
        except Refused as problem:
            if problem.code not in ("unknown_variable", "unknown_factor"):
                raise
            refused = problem
    if refused is not None and not told:
        raise refused
    return told


def _tell(what: str, found: Any) -> None:
    if found.variable:
        table(_variable_rows(found.variable), title=f"{what} at revision {found.revision}")
        rows = [(_named(each), _factor_line(each, found.step)) for each in found.variable["factors"]]
        if rows:
            table(rows, title="Its factors, by id")
        else:
            held = "it is fixed where it is" if found.variable["fixed"] else "nothing holds it"
            click.echo(f"No factor is on {what}: {held}.")
    else:
        table([(_named(found.factor), _factor_line(found.factor, found.step))], title=f"At revision {found.revision}")
    step = found.step
    if step:
        table([("the last step", f"{step['strategy']}, because {step['because']}")])


@command.command("chi2")
@asks_map
@click.option("--batch", is_flag=True, help="Also of the optimum found from scratch, which takes a while.")
def chi2_command(address: MapAddress, batch: bool, as_json: bool) -> int:
    """How well the estimate fits: χ² = Σ rᵀΩr, with --batch over that of the optimum found from scratch.

    That is the lowest of three: from the map's own values, from composed odometry, from averaged rotations. Where the
    map is above it by more than 1 % this says so, and `factorbus change adopt` puts the map there. Where the search
    ended before it had converged this says so (--json: batch_converged), and the true optimum may be lower.

    \b
    factorbus ask chi2 warehouse
    factorbus ask chi2 warehouse --batch
    """
    with _map(address) as joined:
        found = joined.chi2(batch, timeout_s=address.timeout_s)
    if as_json:
        content = {"revision": found.revision, "chi2": found.chi2}
        if found.batch is not None:
            content |= {"batch": found.batch, "start": found.start, "worker": found.worker, "seconds": found.seconds}
            content["batch_converged"] = found.batch_converged
            content["better_optimum"] = found.notice is not None
            content["notice"] = None if found.notice is None else found.notice.message
        document(content)
        return OK
    rows = [("χ²", f"{found.chi2:.9g}")]
    if found.batch is not None:
        from_where = optimum_from(found.start, converged=found.batch_converged)
        by = f"{from_where}; {found.worker}, {found.seconds:.2f} s"
        rows.append(("batch", f"{found.batch:.9g}  ({by})"))
        ratio = ratio_to(found.chi2, found.batch)
        rows.append(("χ² / batch", ratio if found.batch_converged else f"{ratio}  (batch: {NOT_CONVERGED})"))
    if found.notice is not None:
        rows.append((found.notice.code, found.notice.message.replace("adopt MAP", f"adopt {address.name}")))
    table(rows, title=f"At revision {found.revision}")
    return OK


@command.command("repair")
@asks_map
@click.argument("factors", nargs=-1, type=int)
@click.option("--apply", "applied", is_flag=True, help="Take what is false out of the map, and settle it.")
@click.option("--loss", "loss", metavar="LOSS", default="", help="With --apply: keep it, with this robust loss.")
@click.option(
    "--probability",
    type=Number(0, 1, min_open=True, max_open=True),
    default=0.99,
    show_default=True,
    help="With which a right measurement is kept.",
)
def repair_command(
    address: MapAddress, factors: tuple[int, ...], applied: bool, loss: str, probability: float, as_json: bool
) -> int:
    """Which of the factors FACTORS (ids), or of all that close loops, are false. Changes nothing without --apply.

    \b
    factorbus ask repair warehouse
    factorbus ask repair warehouse --apply
    factorbus ask repair warehouse 17 18 --apply --loss dcs
    """
    from factorbus.client import Changes

    if loss and not applied:
        raise click.UsageError("--loss says what --apply does with what is false; give --apply too")
    with _map(address) as joined:
        found = joined.repair(factors or None, probability=probability, timeout_s=address.timeout_s)
        if applied and found.factors.size:
            changes = Changes().repair(found, (loss, 1.0) if loss else None)
            joined.change(changes, settle=True, timeout_s=address.timeout_s)
    rows = list(zip(found.factors.tolist(), found.distance.tolist(), strict=True))
    if as_json:
        content = {"revision": found.revision, "suspects": found.suspects, "before": found.before, "after": found.after}
        content["chi2_left"] = found.chi2_left
        document(content | {"false": [{"factor": factor, "distance": s} for factor, s in rows], "applied": applied})
        return OK
    table(
        [
            ("looked at", str(found.suspects) if found.suspects else "0: no factor in the map closes a loop"),
            ("false", f"{len(rows)}{', taken care of' if applied and rows else ''}"),
            ("χ², each suspect up to its bound", f"{found.before:.6g}, repaired {found.after:.6g}"),
            ("χ² without the false ones", f"{found.chi2_left:.6g}"),
            *((str(factor), f"rᵀΩr {s:.4g}") for factor, s in rows[:_SHOWN]),
        ],
        title=f"At revision {found.revision}, in {found.seconds:.2f} s",
    )
    return OK


command.add_command(covariance_command, "covariance")
command.add_command(suspects_command, "suspects")
command.add_command(components_command, "components")


def _variable_rows(explained: Any) -> list[tuple[str, str]]:
    from factorbus.cli.output.tangents import named_sigmas
    from factorbus.proto.variable_kinds import VARIABLE_KINDS

    value = "  ".join(f"{number:.6g}" for number in explained["value"])
    return [
        ("kind", explained["kind"] + (", fixed" if explained["fixed"] else "")),
        *([("time stamp", f"{explained['stamp']} ns")] if explained.get("stamp") is not None else []),
        ("value", f"{value}  ({VARIABLE_KINDS[explained['kind']].values})"),
        ("sigmas", named_sigmas(explained["kind"], explained["sigmas"])),
        ("smallest pivot of R", f"{explained['pivot']:.4g}"),
        ("smallest R²ᵢᵢ/Λᵢᵢ", f"{explained['conditioning']:.2g}"),
    ]


def _factor_line(explained: Any, step: Any) -> str:
    from factorbus.proto.why_text import fall_without

    if explained.get("inactive"):
        return f"inactive: {explained['inactive']}"
    without, loss = explained["without"], explained.get("loss")
    fall = "no redundancy: nothing else measures it"
    if without is not None:
        fall = f"without it χ² falls by {fall_without(without, step)}"
    share = f"leverage {explained['leverage']:.2f} of {explained['dims']}"
    if not loss:
        return f"χ² {explained['chi2']:.3g}, {share}, {fall}"
    rho, weight = explained["rho"], explained["weight"]
    counts = f"rᵀΩr {explained['chi2']:.3g}, of which {loss} counts {rho:.3g} (weight {weight:.2g})"
    return f"{counts}, {share}, {fall}"


def _named(explained: Any) -> str:
    from factorbus.proto.kinds import name_of_kind
    from factorbus.proto.symbols import format_symbol

    ends = ", ".join(format_symbol(key) for key in explained["keys"])
    return f"{explained['factor']} {name_of_kind(explained['kind'])} ({ends})"


def _word(plausible: bool) -> str:
    return "plausible" if plausible else "not plausible"


def _read(path: Path, dialect: str | None, strict: bool) -> Any:
    """The graph file of candidates.  Raises FormatError, also where it has no factor."""
    from factorbus.formats.errors import FormatError

    with input_file(path):
        # The vertices that no edge names are not asked about: only what would be asked may not be left out.
        found = read_graph(path, dialect, strict, whole=True)
    if not found.batch.factor_count:
        raise FormatError(str(path), None, "it has no factor that can be read", "one candidate or more")
    return found


def _described(factors: tuple[Any, ...]) -> list[str]:
    from factorbus.proto.kinds import name_of_kind
    from factorbus.proto.symbols import format_symbol

    return [
        f"{name_of_kind(group.kind)} ({', '.join(format_symbol(int(key)) for key in row)})"
        for group in factors
        for row in group.keys
    ]


@contextmanager
def _map(address: MapAddress) -> Iterator[Any]:
    """The map, joined only if it is there."""
    from factorbus.cli.process.bus import joined_map

    with advising(of_what_is_there(address.name)), joined_map(address, "ask") as joined:
        yield joined
