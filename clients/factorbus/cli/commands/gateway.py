"""`factorbus gateway`: maps for browsers."""

import click

from factorbus.cli.output.exits import require
from factorbus.cli.process.bind_address import insecure_option, refuse_open_page
from factorbus.cli.process.children import READY
from factorbus.cli.process.options import connect_option, zenoh_option


@click.command()
@connect_option
@zenoh_option
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen at; 0.0.0.0: all of them.")
@click.option(
    "--port", type=click.IntRange(0, 65535), default=8080, show_default=True, help="To listen at; 0: any free one."
)
@click.option(
    "--name", "names", multiple=True, metavar="NAME", help="A name by which browsers call this machine, or '*'."
)
@insecure_option
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
def command(
    endpoint: str, zenoh: str, host: str, port: int, names: tuple[str, ...], insecure: bool, until_eof: bool
) -> None:
    """Serve maps to browsers: a page with the live map, and the same over HTTP and WebSocket, to read only.

    Click a pose or a landmark to see what holds it where it is. Until Ctrl-C. It asks nobody who they are, so it serves
    this machine alone; others only with --insecure. What it answers over HTTP is in clients/README.md.

    \b
    factorbus gateway
    factorbus gateway --connect tcp/robot.local:7447 --host 0.0.0.0 --name robot.local --insecure
    curl http://127.0.0.1:8080/api/maps/warehouse/variables/x12
    """
    require("gateway", "factorbus gateway")
    refuse_open_page(host, insecure)
    from factorbus.cli.process.bus import open_bus
    from factorbus.cli.process.stopping import stop_on_signals, wait_until
    from factorbus.gateway import make_app
    from factorbus.gateway.server import serving
    from factorbus.proto.ports import listening_problem

    hosts = ("127.0.0.1", "localhost", host, *names)
    with stop_on_signals(until_eof) as stop, open_bus(endpoint, "gateway", zenoh) as bus:
        try:
            with serving(make_app(bus, hosts), host, port) as bound:
                click.echo(f"{READY}http://{'127.0.0.1' if host == '0.0.0.0' else host}:{bound}")
                wait_until(stop)
        except OSError as error:
            raise listening_problem(f"{host}:{port}", error) from error
