"""`factorbus change`: take something out of a map on the bus, count it differently, hold it; fork and merge maps."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any, TypeVar

import click

from factorbus.cli.commands.attaching import attach_command
from factorbus.cli.commands.merging import merge_command
from factorbus.cli.output.advice import advising_changes
from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import OK
from factorbus.cli.output.starts import optimum_from
from factorbus.cli.process.options import MapAddress, Number, asks_map

F = TypeVar("F", bound=Callable[..., Any])
_COUNTS = (
    "removed_variables", "removed_factors", "added_factors", "edited_factors", "fixed_variables", "freed_variables",
)  # fmt: skip


@click.group()
def command() -> None:
    """Change what the map NAME on the bus has. A factor is called by its id, a variable by its key.

    All of it happens or none; the map is solved anew without what is gone.

    \b
    factorbus change remove warehouse 17 18 x12
    factorbus change loss warehouse dcs 1.0 21
    factorbus change fix warehouse x0
    factorbus change marginalize warehouse x1 x2
    factorbus change fork warehouse what-if
    factorbus change merge warehouse robot2 --letter x=y --anchor x5 y8 0,2,-1.57 --sigmas 0.1,0.1,0.05
    factorbus change attach warehouse b matches.txt --sigmas 0.1,0.1,0.05
    factorbus change adopt warehouse
    """


def _changing(command: F) -> F:
    """NAME, --connect, --timeout, --settle and --json."""
    return asks_map(click.option("--settle", is_flag=True, help="Iterate until converged afterwards.")(command))


@command.command("remove")
@_changing
@click.argument("what", nargs=-1, required=True)
@click.option("--alone", is_flag=True, help="Refuse if any other factor is on the variables.")
def remove_command(address: MapAddress, what: tuple[str, ...], alone: bool, **how: Any) -> int:
    """Remove factors (ids: 17) and variables (keys: x12), these with every factor on them.

    \b
    factorbus change remove warehouse 17 18
    factorbus change remove warehouse x12 --alone
    """
    from factorbus.client import Changes

    ids, names = [int(each) for each in what if each.isdecimal()], [each for each in what if not each.isdecimal()]
    changes = Changes()
    if ids:
        changes.remove_factors(ids)
    if names:
        changes.remove_variables(*names, alone=alone)
    return _make(address, changes, **how)


def _name_alone(_context: click.Context, _param: click.Parameter, loss: str) -> str:
    """The name of a loss: `--loss` of other commands takes it with its scale, as huber:1.0."""
    name, colon, scale = loss.partition(":")
    if colon:
        raise click.BadParameter(f"{loss!r} is a name and a scale; here they are two words: {name} {scale or 1.0}")
    return loss


@command.command("loss")
@_changing
@click.argument("loss", callback=_name_alone)
@click.argument("scale", type=Number())
@click.argument("factors", nargs=-1, required=True, type=int)
def loss_command(address: MapAddress, loss: str, scale: float, factors: tuple[int, ...], **how: Any) -> int:
    """Give factors a robust LOSS of a SCALE in standard deviations, or take it away with `none`.

    \b
    factorbus change loss warehouse dcs 1.0 21 22
    factorbus change loss warehouse none 0 21
    """
    from factorbus.client import Changes

    return _make(address, Changes().loss(factors, "" if loss == "none" else loss, scale), **how)


@command.command("weigh")
@_changing
@click.argument("weight", type=Number())
@click.argument("factors", nargs=-1, required=True, type=int)
def weigh_command(address: MapAddress, weight: float, factors: tuple[int, ...], **how: Any) -> int:
    """Multiply the information of factors by WEIGHT: below 1 they count for less.

    \b
    factorbus change weigh warehouse 0.1 21 22
    """
    from factorbus.client import Changes

    return _make(address, Changes().weigh(factors, weight), **how)


@command.command("accept")
@_changing
@click.argument("factors", nargs=-1, required=True, type=int)
def accept_command(address: MapAddress, factors: tuple[int, ...], **how: Any) -> int:
    """Have loop closures in the estimate, for good, whatever the map thinks of them (`factorbus ask suspects`).

    \b
    factorbus change accept warehouse 21
    """
    from factorbus.client import Changes

    return _make(address, Changes().accept(factors), **how)


@command.command("reject")
@_changing
@click.argument("factors", nargs=-1, required=True, type=int)
def reject_command(address: MapAddress, factors: tuple[int, ...], **how: Any) -> int:
    """Take loop closures out of the estimate, for good; `accept` puts them back.

    \b
    factorbus change reject warehouse 21 22
    """
    from factorbus.client import Changes

    return _make(address, Changes().reject(factors), **how)


@command.command("fix")
@_changing
@click.argument("keys", nargs=-1, required=True)
def fix_command(address: MapAddress, keys: tuple[str, ...], **how: Any) -> int:
    """Hold variables where they are.

    \b
    factorbus change fix warehouse x0
    """
    from factorbus.client import Changes

    return _make(address, Changes().fix(*keys), **how)


@command.command("free")
@_changing
@click.argument("keys", nargs=-1, required=True)
def free_command(address: MapAddress, keys: tuple[str, ...], **how: Any) -> int:
    """Estimate fixed variables again.

    \b
    factorbus change free warehouse x7
    """
    from factorbus.client import Changes

    return _make(address, Changes().free(*keys), **how)


@command.command("marginalize")
@_changing
@click.argument("keys", nargs=-1, required=True)
def marginalize_command(address: MapAddress, keys: tuple[str, ...], **how: Any) -> int:
    """Take variables out for good, and keep what their factors say of the others, as linear factors.

    The estimate of what stays, and how certain it is, are as before. What hangs together goes into one factor: refused
    (too_connected) where it shares factors with more than 128 variables that stay. What they said is linearized where
    the map is now; it cannot be edited factor by factor afterwards, and g2o has no record for it.

    \b
    factorbus change marginalize warehouse x1 x2 l7
    """
    from factorbus.client import Changes

    return _make(address, Changes().marginalize(*keys), **how)


@command.command("adopt")
@asks_map
def adopt_command(address: MapAddress, as_json: bool) -> int:
    """Put the map into the optimum found from scratch, if that is below its χ² by more than 1 %; and settle it.

    One step, as any change kept in the journal. Variables that came since the optimum was asked for go along with
    what they hang on. To be able to go back, fork the map first. Where the search for the optimum ended before it had
    converged this says so (--json: batch_converged), and the true optimum may be lower.

    \b
    factorbus ask chi2 warehouse --batch
    factorbus change fork warehouse as-it-was
    factorbus change adopt warehouse
    """
    from factorbus.cli.process.bus import joined_map
    from factorbus.client import Changes

    with joined_map(address, "change") as joined:
        found = joined.chi2(batch=True, values=True, timeout_s=address.timeout_s)
        better = found.notice is not None
        accepted = joined.change(Changes().adopt(found), settle=True, timeout_s=address.timeout_s) if better else None
    revision = found.revision if accepted is None else accepted.revision
    chi2 = found.chi2 if accepted is None else accepted.report.get("chi2")
    if as_json:
        told = {"revision": revision, "adopted": better, "chi2_before": found.chi2, "chi2": chi2}
        document(told | {"batch": found.batch, "start": found.start, "batch_converged": found.batch_converged})
        return OK
    by = optimum_from(found.start, converged=found.batch_converged)
    rows = [("χ²", f"{found.chi2:.6g}"), ("batch", f"{found.batch:.6g}  ({by})")]
    if accepted is None:
        where = "where the optimum is, to 1 %" if found.batch_converged else "not more than 1 % above that"
        rows.append(("adopted", f"nothing: the map is {where}"))
    else:
        rows.append(("adopted", f"χ² is {chi2:.6g} now"))
    table(rows, title=f"At revision {revision}")
    return OK


@command.command("fork")
@asks_map
@click.argument("new")
def fork_command(address: MapAddress, new: str, as_json: bool) -> int:
    """Make a map NEW that begins as NAME is now, on the same service: to try something out, and to drop it.

    Where the service keeps a journal, the new map is kept as well. Where access control is on, ask as an operator.

    \b
    factorbus change fork warehouse what-if
    factorbus change remove what-if 17 --settle
    factorbus drop what-if
    """
    from factorbus.cli.process.bus import open_bus

    with open_bus(address.endpoint, "change", address.zenoh, address.timeout_s) as bus:
        row = bus.fork(address.name, new)
    if as_json:
        document(asdict(row))
    else:
        shown = [("mode", row.mode), ("variables", f"{row.variables}"), ("factors", f"{row.factors}")]
        table(shown, title=f"{row.name} begins at revision {row.revision} of {address.name}")
    return OK


command.command("merge")(_changing(merge_command))
command.command("attach")(_changing(attach_command))


def _make(address: MapAddress, changes: Any, settle: bool, as_json: bool) -> int:
    """Send it, and say what came of it."""
    from factorbus.cli.process.bus import joined_map

    with advising_changes(address.name), joined_map(address, "change") as joined:
        accepted = joined.change(changes, settle=settle)
    report = accepted.report
    counted = {what: report[what] for what in _COUNTS if report.get(what)}
    if as_json:
        document({"revision": accepted.revision, "chi2": report.get("chi2")} | counted)
    else:
        rows = [(what.replace("_", " "), str(count)) for what, count in counted.items()]
        table([*rows, ("χ²", f"{report.get('chi2', float('nan')):.6g}")], title=f"At revision {accepted.revision}")
    return OK
