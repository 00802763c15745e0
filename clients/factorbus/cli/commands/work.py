"""`factorbus work`: join the bus as a worker."""

from typing import Any

import click

from factorbus.cli.output.exits import require
from factorbus.cli.output.logs import begin_logging, log_option
from factorbus.cli.process.children import READY
from factorbus.cli.process.notify import Notifier
from factorbus.cli.process.options import DEFAULT_ENDPOINT, WholeNumber


@click.command()
@click.option(
    "--connect", multiple=True, metavar="ENDPOINT", help=f"A service, or a router.  [default: {DEFAULT_ENDPOINT}]"
)
@click.option("--slots", type=WholeNumber(1, 1024), default=1, show_default=True, help="Jobs at a time.")
@click.option("--name", default="", metavar="NAME", help="As the bus sees it.  [default: made up]")
@click.option("--zenoh", default="", metavar="FILE.json5", help="Zenoh configuration: TLS, access control.")
@click.option("--warm/--no-warm", default=True, help="Compile every kernel before the first job.  [default: warm]")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
@log_option
@click.option("--quiet", is_flag=True, help="Log warnings only.")
def command(until_eof: bool, quiet: bool, log_form: str, connect: tuple[str, ...], **given: Any) -> None:
    """Take jobs from services until Ctrl-C or SIGTERM; those begun are finished. Waits for a service not yet there.

    Prints `ready NAME` when it takes jobs. A job is for example the batch optimum of a map, found from scratch while
    the map's own solver goes on, or a part of the features that a camera's filter asks for. Start as many workers as
    there are cores to spare, on any machine.

    \b
    factorbus work
    factorbus work --connect tcp/solver.local:7447 --slots 4
    """
    require("service", "factorbus work")
    from factorbus.cli.process.stopping import stop_when_asked
    from factorbus.workers.app import work
    from factorbus.workers.config import WorkerConfig

    begin_logging(log_form, quiet)
    manager = Notifier()

    def on_ready(name: str) -> None:
        click.echo(READY + name)
        manager.ready(f"worker {name} takes jobs")

    config = WorkerConfig(connect=connect or (DEFAULT_ENDPOINT,), **given)
    with stop_when_asked(until_eof, manager.stopping) as stop:
        work(config, on_ready, stop)
