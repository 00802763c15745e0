"""`factorbus top`: what goes on at a service, in the terminal."""

import time
from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.process.options import Number, connect_option, json_option, zenoh_option
from factorbus.wording import counted

if TYPE_CHECKING:
    from rich.console import RenderableType


@click.command()
@connect_option
@zenoh_option
@click.option("--every", "every_s", type=Number(0.1, 60), default=1.0, show_default=True, metavar="S", help="Seconds.")
@click.option("--once", is_flag=True, help="Look twice, `--every` apart, print it, and end.")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
@json_option
def command(endpoint: str, zenoh: str, every_s: float, once: bool, until_eof: bool, as_json: bool) -> None:
    """Show maps, clients and workers of the service at ENDPOINT: rates, times, queues. Until Ctrl-C.

    \b
    factorbus top
    factorbus top --connect tcp/robot.local:7447 --every 2
    factorbus top --once --json
    factorbus top --connect tls/solver.local:7447 --zenoh ops.json5

    \b
    In the tables:
      mode       how the map is solved, see factorbus replay --help
      steps/s    steps since the look before; inserts/s: accepted inserts
      step ms    solver's time of a step, mean since the look before
      χ²         converging: left alone, the map goes on by itself to its optimum; gave up: it does not
      budget     where steps have one: what the last one took of it, and relinearizations left for later ones
      suspects   where loop closures are tested or weighed: how many are not believed, of all
      taken out  where a map keeps some poses (factorbus serve --keep): how many went since the service has it open
      waiting    inserts that are accepted by no step yet, and those parked behind a gap
      interest   a part of a map that clients follow, what its channel carries, and variables that wait for that
      client     those that are there; gone: those that have left, whose inserts are in the map
      answer ms  from asking for these numbers to having them, over the bus
    """
    from factorbus.cli.output import console as screen
    from factorbus.cli.output.stats_table import Indicators
    from factorbus.cli.process.bus import open_bus
    from factorbus.cli.process.stopping import stop_when_asked

    console = _console()
    if not (once or as_json or _can_redraw(console)):
        raise click.UsageError(
            "top draws its tables over each other, for which standard output has to be a terminal; "
            "take --once for one look, or --json for a program"
        )
    with stop_when_asked(until_eof) as stop, open_bus(endpoint, "top", zenoh) as bus:
        indicators = Indicators(bus)
        seen = indicators.read()
        if once or as_json:
            stop.wait(every_s)
            seen = indicators.read()
            if as_json:
                screen.document(seen)
            else:
                console.print(view(seen, endpoint, console))
            return
        from rich.live import Live

        with Live(view(seen, endpoint, console), console=console, screen=True, auto_refresh=False) as live:
            while not stop.wait(every_s):
                live.update(view(indicators.read(), endpoint, console), refresh=True)


def _console() -> Any:
    from rich.console import Console

    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=160)


def _can_redraw(console: Any) -> bool:
    return console.is_terminal and not console.is_dumb_terminal


def view(seen: dict[str, Any], endpoint: str, console: Any) -> "RenderableType":
    from rich.console import Group
    from rich.text import Text

    head = f"factorbus top   {endpoint}   {time.strftime('%H:%M:%S')}   "
    if seen["unavailable"]:
        return Text(head + f"nobody answers: {seen['unavailable']}; asking again", style="bold")
    head += f"service {seen['service']} {seen['version']}, answers in {seen['answer_ms']:.1f} ms"
    closed = [Text(f"map {line}", style="bold red") for line in seen["unopened"]]
    tables = (_table(console, rows) for rows in (_maps(seen), _clients(seen)))
    interests = [_table(console, _interests(seen))] if seen["interests"] else []
    upstreams = [_table(console, rows)] if (rows := _upstreams(seen))[1] else []
    workers = _table(console, _workers(seen))
    return Group(Text(head, style="bold"), Text(), *closed, *tables, *_gone(seen), *upstreams, *interests, workers)


# Columns of each table, the first of which stays; where not all have room the last of these goes first.
_MATTER = (
    "variables", "revision", "χ²", "step ms", "waiting", "steps/s", "factors", "inserts", "map", "inserts/s", "refused",
    "budget", "suspects", "taken out",
    "mode", "slots", "in flight", "latency ms", "bytes/s", "at most", "upstream", "rebased", "link", "behind",
)  # fmt: skip
_ANY_WIDTH = 10_000
_LEFT = ("map", "mode")
_Table = tuple[tuple[str, ...], list[tuple[str, ...]]]  # names of columns, rows


def _maps(seen: dict[str, Any]) -> _Table:
    names = (
        "map", "mode", "variables", "factors", "revision", "steps/s", "inserts/s", "step ms", "χ²", "waiting",
        "refused", "budget", "suspects", "taken out",
    )  # fmt: skip
    rows = [
        (
            row["name"],
            row["mode"],
            f"{row['variables']:,}",
            f"{row['factors']:,}",
            f"{row['revision']:,}",
            f"{row['steps_per_s']:.1f}",
            f"{row['inserts_per_s']:.1f}",
            "" if row["step_ms"] is None else f"{row['step_ms']:.2f}",
            f"{row['chi2']:.6g}" + _convergence(row),
            f"{row['waiting']}" + (f" +{row['parked']}" if row["parked"] else ""),
            f"{row['refused']}" + (f", {row['busy']} busy" if row["busy"] else ""),
            _budget(row),
            _suspects(row),
            _taken_out(row),
        )
        for row in seen["maps"]
    ]
    shown = list(names)
    if not any(row["closure_states"] for row in seen["maps"] if "closure_states" in row):
        shown.remove("suspects")  # no map tests closures
    if not any("budget" in row for row in seen["maps"]):
        shown.remove("budget")
    if not any("kept" in row for row in seen["maps"]):
        shown.remove("taken out")  # all maps keep all poses
    places = [names.index(name) for name in shown]
    return tuple(shown), [tuple(row[place] for place in places) for row in rows]


def _budget(row: dict[str, Any]) -> str:
    if (budget := row.get("budget")) is None:
        return ""
    last = f"{budget['step_ms']:.1f} of {budget['budget_ms']:g} ms"
    return last if budget["complete"] else f"{last}, {budget['deferred_relinearizations']:,} left"


def _suspects(row: dict[str, Any]) -> str:
    states = row.get("closure_states")
    return "" if states is None else f"{states['suspect']} of {sum(states.values())}"


def _taken_out(row: dict[str, Any]) -> str:
    if (kept := row.get("kept")) is None:
        return ""
    return f"{kept['removed_poses']:,}" + (", failed" if kept["failed"] else "")


def _convergence(row: dict[str, Any]) -> str:
    return " converging" if row["converging"] else " gave up" if row["gave_up"] else ""


def _clients(seen: dict[str, Any]) -> _Table:
    rows = [
        (row["name"], row["map"], f"{row['inserts']:,}", f"{row['inserts_per_s']:.1f}")
        for row in seen["clients"]
        if row["here"]
    ]
    return ("client", "map", "inserts", "inserts/s"), rows


def _gone(seen: dict[str, Any]) -> list["RenderableType"]:
    from rich.text import Text

    gone = [row for row in seen["clients"] if not row["here"]]
    told = f"{counted(len(gone), 'client')} gone, after {counted(_inserts(gone), 'insert')}"
    return [Text(told, style="table.caption")] if gone else []


def _inserts(rows: list[dict[str, Any]]) -> int:
    return sum(row["inserts"] for row in rows)


def _interests(seen: dict[str, Any]) -> _Table:
    from factorbus.cli.commands.stats import part_of

    rows = [
        (
            part_of(row),
            row["map"],
            f"{row['carried_per_s']:,.0f}",
            f"{row['bytes_per_s']:,}" if row["bytes_per_s"] else "",
            f"{row['waiting']:,}",
        )
        for row in seen["interests"]
    ]
    return ("interest", "map", "bytes/s", "at most", "waiting"), rows


def _upstreams(seen: dict[str, Any]) -> _Table:
    """Of a replica: which maps follow whom, and how far behind upstream is."""
    found = [(row["name"], row["upstream"]) for row in seen["maps"] if row.get("upstream")]
    rows = [
        (
            name,
            row["endpoint"],
            f"{'connected' if row['connected'] else 'out of reach'} for {row['since_s']:,.0f} s"
            + (f", {row['code']}" if row["code"] else ""),
            f"{row['behind']:,}",
            f"{row['rebased']:,}",
        )
        for name, row in found
    ]
    return ("replica", "upstream", "link", "behind", "rebased"), rows


def _workers(seen: dict[str, Any]) -> _Table:
    rows = []
    for row in seen["workers"]:
        latency = "" if row.get("latency_ms") is None else f"{row['latency_ms']:.2f}"
        latency = "distrusted" if row.get("distrusted") else latency
        rows.append((row["name"], str(row["slots"]), str(row["in_flight"]), latency))
    return ("worker", "slots", "in flight", "latency ms"), rows


def _table(console: Any, content: _Table) -> Any:
    """As many columns as have room whole: a number without its last digits is another one."""
    names, rows = content
    shown, longest = list(names), None  # of a name in one line
    while True:
        table = _drawn(shown, [[row[names.index(name)] for name in shown] for row in rows], longest)
        wanted = console.measure(table, options=console.options.update(max_width=_ANY_WIDTH)).maximum
        if len(shown) == 1 or wanted <= console.width:
            return table
        if longest is None:
            longest = max(12, console.width // 4)
        else:
            shown.remove(max(shown[1:], key=_MATTER.index))


def _drawn(names: list[str], rows: list[list[str]], longest: int | None) -> Any:
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    # A long name goes on in the next line; numbers do not.
    table.add_column(names[0], style="bold", overflow="fold", max_width=longest)
    for name in names[1:]:
        if name in _LEFT:
            table.add_column(name, overflow="fold", max_width=longest)
        else:
            table.add_column(name, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    return table
