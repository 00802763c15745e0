"""`factorbus serve`: own maps and answer on the bus until stopped."""

from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.exits import input_file, require
from factorbus.cli.output.logs import begin_logging, log_option
from factorbus.cli.process.children import READY
from factorbus.cli.process.notify import Notifier
from factorbus.cli.process.options import PATH, USUAL_ENDPOINT


@click.command()
@click.option(
    "--listen",
    multiple=True,
    metavar="ENDPOINT",
    help=f"Where clients connect; port 0: any free one.  [default: {USUAL_ENDPOINT}]",
)
@click.option("--connect", multiple=True, metavar="ENDPOINT", help="A Zenoh router to meet clients and workers at.")
@click.option(
    "--map", "create", multiple=True, metavar="NAME", help="A map to have from the start; clients may create others."
)
@click.option("--config", type=PATH, metavar="FILE.toml", help="Settings; what is given here wins.")
@click.option("--zenoh", metavar="FILE.json5", help="Zenoh configuration: TLS, users, access control (deploy/zenoh).")
@click.option(
    "--insecure",
    is_flag=True,
    default=None,
    help="Listen to other machines even where anybody who reaches the port could read and write.",
)
@click.option("--journal", metavar="DIR", help="Keep maps in this folder, across restarts and crashes.")
@click.option(
    "--durability",
    type=click.Choice(("none", "group", "commit")),
    help="With a journal: what an answer promises (see below).  [default: commit]",
)
@click.option(
    "--upstream", metavar="ENDPOINT", help="Be a replica of the service there, and go on without it (see below)."
)
@click.option("--upstream-zenoh", metavar="FILE.json5", help="Zenoh configuration for it: TLS, user (deploy/zenoh).")
@click.option(
    "--closures",
    type=click.Choice(("trust", "test", "robust")),
    help="Of new maps: believe loop closures, test them, or weigh them (graduated non-convexity).  [default: trust]",
)
@click.option(
    "--budget-ms",
    type=float,
    metavar="MS",
    help="Of new maps: what a step may take; the rest follows in later steps.  [default: 0, no bound]",
)
@click.option(
    "--keep",
    metavar="POLICY",
    help="Of new maps: which poses stay of places that are driven through again and again, such as "
    "per_area=2,window=50 (see below).  [default: all]",
)
@click.option("--standby", is_flag=True, default=None, help="Wait until the journal's owner is gone, and take over.")
@click.option("--name", metavar="NAME", help="Of this service, as the bus sees it.  [default: made up]")
@click.option("--warm/--no-warm", default=None, help="Compile every kernel before the first insert.  [default: warm]")
@click.option("--until-eof", is_flag=True, help="Stop, too, when standard input closes: for a parent process.")
@click.option(
    "--metrics", metavar="HOST:PORT", help="Serve /metrics for Prometheus, /live and /ready over HTTP; to anybody."
)
@log_option
@click.option("--quiet", is_flag=True, help="Log warnings only.")
def command(config: Path | None, until_eof: bool, quiet: bool, log_form: str, **given: Any) -> None:
    """Own maps, take inserts, answer questions. Runs until Ctrl-C or SIGTERM, and finishes all it has accepted.

    Prints `ready ENDPOINT ...` when clients can connect. The log goes to standard error. On a cold start the kernels
    are compiled first, which takes a while and is said; `factorbus warm` does it ahead. It does not listen beyond this
    machine without encryption, identities and access control; `factorbus access` writes them down.

    \b
    factorbus serve
    factorbus serve --listen tls/0.0.0.0:7447 --zenoh service.json5 --map warehouse
    factorbus serve --journal /var/lib/factorbus
    factorbus serve --budget-ms 10
    factorbus serve --config /etc/factorbus/serve.toml
    factorbus serve --journal /var/lib/factorbus --map yard --upstream tcp/base:7447 --name robot1

    With --upstream, on a robot: clients here insert and ask as anywhere, and never wait for the link. What they insert
    goes upstream under their names and numbers, and what others write there comes here, in upstream's order. While the
    link is down it waits in the journal. Every map here is one of the same name upstream.

    \b
    With --journal, when an insert is answered:
      commit   the disk has it: it survives a power cut, as far as the disk keeps its word
      group    it is written within 50 ms; a crash may cost what was answered in that time, and begins a new epoch
      none     it is written now and then, with no promise but for an orderly stop

    \b
    With --keep the size of a map follows the area, not the time. When it is idle, poses go that it has enough of, and
    what they say of others stays. per_area=2:3,window=50,landmarks=2,loss=1 means:
      per_area   of the poses within 2 m of each other 3 stay (1, where it says 2 alone)
      window     the newest 50 of each letter stay
      landmarks  a pose stays that sees a landmark which 2 poses or fewer see
      loss       the most nats that may be lost for each pose that goes

    \b
    A configuration file has the names of these options and more, for example:
      listen = ["tls/0.0.0.0:7447"]
      metrics = "127.0.0.1:9464"
      create = ["warehouse"]
      journal = "/var/lib/factorbus"
      zenoh = "/etc/factorbus/zenoh.json5"     # TLS, users, access control
      [limits]
      waiting = 1024
    """
    require("service", "factorbus serve")
    from factorbus.cli.process.stopping import stop_when_asked
    from factorbus.service.app import serve

    begin_logging(log_form, quiet)
    manager = Notifier()

    def on_ready(endpoints: list[str]) -> None:
        click.echo(READY + " ".join(endpoints))
        manager.ready(f"listening on {' '.join(endpoints)}")

    with stop_when_asked(until_eof, manager.stopping) as stop:
        serve(_settings(config, given), on_ready, stop, lambda health: manager.alive(health.stuck()))


def _settings(path: Path | None, given: dict[str, Any]) -> Any:
    from dataclasses import replace

    from factorbus.service.config import BadConfig, Config, checked_config, load_config, needs_journal

    if empty := [name for name, value in given.items() if value == ""]:  # a variable of the shell that is not set, say
        raise BadConfig(f"--{empty[0].replace('_', '-')} is empty; give a value, or leave the option out")
    given = {name: value for name, value in given.items() if value is not None and value != ()}
    if path is None:
        config = checked_config(replace(Config(), **given))
    else:
        with input_file(path):
            config = load_config(path, **given)
    if "durability" in given and not config.journal:
        raise needs_journal("durability")
    return config
