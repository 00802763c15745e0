"""`factorbus record`: a map as an MCAP file, while it is made."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from factorbus.cli.output.exits import require
from factorbus.cli.process.options import Number, WholeNumber, connect_option, out_option, zenoh_option
from factorbus.wording import counted

if TYPE_CHECKING:
    from threading import Event

    from factorbus.client import Map


@click.command()
@click.argument("map_name", metavar="MAP")
@connect_option
@zenoh_option
@out_option("--out", "out", "The recording.  [default: MAP.mcap here]", "FILE.mcap")
@click.option(
    "--every",
    "every_s",
    type=Number(0.05, 60),
    default=1.0,
    show_default=True,
    metavar="S",
    help="Seconds between pictures of the whole map.",
)
@click.option(
    "--no-deltas", is_flag=True, help="Only what is drawn and plotted, not every estimate and factor as numbers."
)
@click.option("--until", type=WholeNumber(1), metavar="REVISION", help="Stop when the map has got there.")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
def command(
    map_name: str,
    endpoint: str,
    zenoh: str,
    out: Path | None,
    every_s: float,
    no_deltas: bool,
    until: int | None,
    until_eof: bool,
) -> None:
    """Record MAP into an MCAP file until Ctrl-C: every step, every estimate, every factor, and a scene to look at.

    Foxglove opens it (3D panel: /map/scene and /tf; plots: /map/step.chi2), and any MCAP reader. What is in the map
    already comes first. A map that is not there yet is waited for.

    \b
    factorbus record warehouse
    factorbus record warehouse --connect tcp/robot.local:7447 --out monday.mcap
    """
    require("record", "factorbus record")
    from factorbus.cli.output.console import print_note
    from factorbus.cli.output.exits import Stopped
    from factorbus.cli.process.bus import joined_when_there, open_bus
    from factorbus.cli.process.stopping import stop_when_asked

    path = out or Path(f"{map_name}.mcap")
    if path.exists():
        raise Stopped("file_exists", f"{path} is there already: give another --out, or remove it", path=str(path))
    with (
        stop_when_asked(until_eof) as stop,
        open_bus(endpoint, "recorder", zenoh) as bus,
        joined_when_there(bus, map_name, stop.wait) as joined,
    ):
        if joined is None:
            print_note(f"stopped before there was a map {map_name}; nothing is recorded")
            return
        _record(joined, path, every_s, until, stop, with_deltas=not no_deltas)


def _record(joined: "Map", path: Path, every_s: float, until: int | None, stop: "Event", with_deltas: bool) -> None:
    from factorbus.cli.output.console import print_note
    from factorbus.viz.map_follower import MapFollower
    from factorbus.viz.mcap import Recording

    with MapFollower(joined) as follower, Recording(path, with_deltas) as recording:
        recording.begin(follower.last_look(joined.timeout_s))
        click.echo(f"ready {path}")
        while not stop.wait(every_s) and (until is None or joined.estimate.revision < until):
            recording.take(follower.look())
        recording.take(follower.last_look(joined.timeout_s))
    what = f"{counted(recording.deltas, 'delta')}, {counted(recording.factors, 'factor')}"
    print_note(f"{path}: {what}, up to revision {recording.revision}")
