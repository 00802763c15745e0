"""`factorbus gateway`: maps for browsers."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from factorbus.cli.output.exits import require
from factorbus.cli.process.bind_address import insecure_option, is_loopback, refuse_open_page
from factorbus.cli.process.children import READY
from factorbus.cli.process.options import PAGE_HOST, PATH, WholeNumber, connect_option, zenoh_option

if TYPE_CHECKING:
    from factorbus.gateway.people import People


@dataclass(frozen=True, slots=True)
class GatewayRequest:
    """What the command line asked for."""

    endpoint: str
    zenoh: str
    host: str
    port: int
    names: tuple[str, ...]
    people: Path | None
    read_only: bool
    client: str


@click.command()
@connect_option
@zenoh_option
@click.option("--host", default=PAGE_HOST, show_default=True, help="Address to listen at; 0.0.0.0: all of them.")
@click.option(
    "--port", type=WholeNumber(0, 65535), default=8080, show_default=True, help="To listen at; 0: any free one."
)
@click.option(
    "--name", "names", multiple=True, metavar="NAME", help="A name by which browsers call this machine, or '*'."
)
@click.option(
    "--people",
    type=PATH,
    metavar="FILE",
    help="Who may edit: names and tokens by role, a TOML file. Without it all may who reach 127.0.0.1.",
)
@click.option("--read-only", is_flag=True, help="Nobody edits here.")
@click.option(
    "--client", default="gateway", show_default=True, metavar="NAME", help="Who we are, where access control asks."
)
@insecure_option
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
def command(insecure: bool, until_eof: bool, **asked: Any) -> None:
    """Serve maps to browsers: a page with the live map, and the same over HTTP and WebSocket. Until Ctrl-C.

    Click a pose or a landmark to see what holds it where it is, or a factor to see how it fits: and reject it, weigh
    it, hold a pose, drag it, merge two maps, and undo. Reading asks nobody who they are, so it serves this machine
    alone; others only with --insecure, and these edit only with a token of --people. What it answers over HTTP, and how
    edits are guarded, is in clients/README.md.

    \b
    factorbus gateway
    factorbus gateway --read-only
    factorbus gateway --people people.toml
    factorbus gateway --connect tcp/robot.local:7447 --host 0.0.0.0 --name robot.local --insecure
    curl http://127.0.0.1:8080/api/maps/warehouse/variables/x12
    """
    require("gateway", "factorbus gateway")
    request = GatewayRequest(**asked)
    refuse_open_page(request.host, insecure)
    from factorbus.cli.process.bus import open_bus
    from factorbus.cli.process.stopping import stop_when_asked
    from factorbus.gateway import make_app
    from factorbus.gateway.server import serving
    from factorbus.proto.ports import listening_problem

    people = _people(request)
    host, hosts = request.host, ("127.0.0.1", "localhost", request.host, *request.names)
    with stop_when_asked(until_eof) as stop, open_bus(request.endpoint, request.client, request.zenoh) as bus:
        try:
            with serving(make_app(bus, hosts, people), host, request.port) as bound:
                click.echo(f"{READY}http://{'127.0.0.1' if host == '0.0.0.0' else host}:{bound}")
                stop.wait()
        except OSError as error:
            raise listening_problem(f"{host}:{request.port}", error) from error


def _people(request: GatewayRequest) -> "People":
    """Who may edit.  Raises BadPeople, Stopped, UnsafeFolder."""
    from factorbus.cli.output.exits import input_file
    from factorbus.gateway.people import OPERATOR, VIEWER, People, Person, read_people
    from factorbus.ownership import check_settings_file

    if request.read_only:
        return People(Person("local", VIEWER, "this gateway was started with --read-only"))
    if request.people is not None:
        usual = Person("local", VIEWER, "editing asks who you are: sign in with your token")
        with input_file(request.people):
            check_settings_file("the list of people", request.people)
            return read_people(request.people.read_text(encoding="utf-8"), str(request.people), usual)
    if is_loopback(request.host) and "*" not in request.names:
        return People(Person("local", OPERATOR))
    return People(Person("local", VIEWER, "this gateway serves other machines and has no list of people (--people)"))
