"""`factorbus serve`: own maps and answer on the bus until stopped."""

import logging
import sys
from pathlib import Path
from typing import Any

import click

from factorbus.cli.children import READY
from factorbus.cli.exits import input_file, require
from factorbus.cli.options import DEFAULT_ENDPOINT


@click.command()
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help=f"Where clients connect; port 0: any free one.  [default: {DEFAULT_ENDPOINT}]",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="A Zenoh router to meet clients and workers at.")
@click.option(
    "--map", "create", multiple=True, metavar="NAME", help="A map to have from the start; clients may create others."
)
@click.option(
    "--config", type=click.Path(path_type=Path), metavar="FILE.toml", help="Settings; what is given here wins."
)
@click.option("--name", metavar="NAME", help="Of this service, as the bus sees it.  [default: made up]")
@click.option("--warm/--no-warm", default=None, help="Compile every kernel before the first insert.  [default: warm]")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
@click.option("--quiet", is_flag=True, help="Log warnings only.")
def command(config: Path | None, until_eof: bool, quiet: bool, **given: Any) -> None:
    """Own maps, take inserts, answer questions. Runs until Ctrl-C or SIGTERM, and finishes all it has accepted.

    Prints `ready ENDPOINT ...` when clients can connect. The log goes to standard error. On a cold start the kernels
    are compiled first, which takes a while and is said; `factorbus warm` does it ahead.

    \b
    factorbus serve
    factorbus serve --listen tcp/0.0.0.0:7447 --map warehouse
    factorbus serve --config /etc/factorbus/serve.toml

    \b
    A configuration file has the names of these options and more, for example:
      listen = ["tcp/0.0.0.0:7447"]
      create = ["warehouse"]
      zenoh = "/etc/factorbus/zenoh.json5"     # TLS, users, access control
      [limits]
      waiting = 1024
    """
    require("service", "factorbus serve")
    from factorbus.cli.stopping import stop_on_signals
    from factorbus.service.app import serve

    level = logging.WARNING if quiet else logging.INFO
    logging.basicConfig(level=level, stream=sys.stderr, format="%(asctime)s %(levelname)-7s %(message)s")
    with stop_on_signals(until_eof) as stop:
        serve(_settings(config, given), lambda endpoints: click.echo(READY + " ".join(endpoints)), stop)


def _settings(path: Path | None, given: dict[str, Any]) -> Any:
    from dataclasses import replace

    from factorbus.service.config import Config, checked, load

    given = {name: value for name, value in given.items() if value not in (None, ())}
    if path is None:
        return checked(replace(Config(), **given))
    with input_file(path):
        return load(path, **given)
