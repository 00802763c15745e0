"""`factorbus watch`: the live view."""

import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.output.exits import require
from factorbus.cli.process.bind_address import insecure_option, refuse_open_page
from factorbus.cli.process.interest_options import PartOptions, part_options
from factorbus.cli.process.options import (
    Number,
    WholeNumber,
    connect_option,
    ellipses_option,
    grouped,
    out_option,
    zenoh_option,
)
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.client import Map


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Where the view goes: a recording, browsers (serving; host and ports), or a viewer on this display."""

    save: Path | None
    serving: bool
    host: str
    web_port: int
    data_port: int
    insecure: bool


@dataclass(frozen=True, slots=True)
class UntilOptions:
    """When to stop: at a revision, when standard input closes."""

    until: int | None
    until_eof: bool


@click.command()
@grouped("viewer", ViewOptions)
@grouped("part", PartOptions)
@grouped("end", UntilOptions)
@click.argument("map_name", metavar="MAP")
@connect_option
@zenoh_option
@out_option("--save", "save", "Write a Rerun recording instead of opening a viewer.", "FILE.rrd")
@click.option("--serve", "serving", is_flag=True, help="Serve the viewer to browsers: for machines without a display.")
@click.option(
    "--host", default="127.0.0.1", show_default=True, help="Address to serve it at, as browsers reach it; 0.0.0.0: all."
)
@click.option("--web-port", type=WholeNumber(1, 65535), default=9090, show_default=True, metavar="PORT")
@click.option("--data-port", type=WholeNumber(1, 65535), default=9876, show_default=True, metavar="PORT")
@insecure_option
@click.option("--rate", type=Number(0.1, 60), default=5.0, show_default=True, metavar="HZ", help="Looks a second.")
@ellipses_option(30)
@part_options
@click.option("--until", type=WholeNumber(1), metavar="REVISION", help="Stop when the map has got there.")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
def command(
    map_name: str,
    endpoint: str,
    zenoh: str,
    viewer: ViewOptions,
    rate: float,
    ellipses: int,
    part: PartOptions,
    end: UntilOptions,
) -> None:
    """Watch MAP live in Rerun: trajectory, landmarks, loop closures by how badly they fit, and plots of every step.

    Opens the Rerun viewer; where there is no display, serves it to browsers of this machine, or with --host and
    --insecure to all who can reach that address. A map that is not there yet is waited for. The plots begin with the
    steps that the service has made since it opened the map. Until Ctrl-C.

    --only, --kind, --box, --period-ms and --bytes-per-s follow a part of the map, for a radio link: the service sends
    that part alone. Factors and ellipses are not asked for then; what waits for the link is said.

    \b
    factorbus watch warehouse
    factorbus watch warehouse --only x --box=-5,-5,20,20 --bytes-per-s 4000
    factorbus watch warehouse --serve --web-port 9090
    factorbus watch warehouse --serve --host 192.168.1.20 --insecure
    factorbus watch warehouse --save monday.rrd; rerun monday.rrd
    """
    if viewer.save and viewer.serving:
        raise click.UsageError("--save and --serve exclude each other")
    if not viewer.save:
        refuse_open_page(viewer.host, viewer.insecure)
    require("watch", "factorbus watch")
    from factorbus.cli.output.console import print_note
    from factorbus.cli.process.bus import joined_when_there, open_bus
    from factorbus.cli.process.stopping import stop_when_asked
    from factorbus.viz.live import LiveView
    from factorbus.viz.map_follower import MapFollower

    interest, until = part.interest(), end.until
    with (
        stop_when_asked(end.until_eof) as stop,
        open_bus(endpoint, "watcher", zenoh) as bus,
        joined_when_there(bus, map_name, stop.wait, interest) as joined,
    ):
        if joined is None:
            print_note(f"stopped before there was a map {map_name}")
            return
        view = LiveView(map_name)
        try:
            where = _open(view, viewer)
            with MapFollower(joined, not interest, 0 if interest else ellipses) as follower:
                if not interest:  # of which a radio link carries no more than is asked for
                    _fill_plots(view, joined)
                view.show(follower.last_look(joined.timeout_s))
                click.echo(f"ready {where}")
                while not stop.wait(1 / rate) and (until is None or joined.estimate.revision < until):
                    if follower.wait(0):
                        view.show(follower.look())
                view.show(follower.last_look(joined.timeout_s), last=True)
        finally:
            view.close()
    unconverged = ", which had not converged" if joined.estimate.converged is False else ""
    converging = unconverged or (", which was converging" if joined.estimate.converging else "")
    print_note(f"watched {map_name} up to revision {joined.estimate.revision}{converging}")
    if interest:
        told = f"; {counted(joined.estimate.waiting, 'variable')} waiting" if joined.estimate.waiting else ""
        print_note(f"its part came in {joined.estimate.received_bytes:,} bytes{told}")


def _fill_plots(view: Any, joined: "Map") -> None:
    """With the steps that the map has made until now; an older service does not have them."""
    from factorbus.proto.problems import Problem

    with suppress(Problem):
        view.show_history(joined.ask.history(None).result())


def _open(view: Any, viewer: ViewOptions) -> str:
    """Where it is to be seen.  Raises Stopped."""
    from factorbus.cli.output.exits import Stopped

    try:
        if viewer.save:
            view.save(viewer.save)
            return str(viewer.save)
        if viewer.serving or not _has_display():
            return view.serve(viewer.host, viewer.web_port, viewer.data_port)
        view.spawn(viewer.data_port)
    except RuntimeError as error:
        raise Stopped("no_viewer", f"the viewer does not start: {error}") from error
    return "on this display"


def _has_display() -> bool:
    return sys.platform == "darwin" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
