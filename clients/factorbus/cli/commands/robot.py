"""`factorbus robot`: the demo's front end, a process of its own that drives through a simulated world."""

import click

from factorbus.cli.process.options import WholeNumber


@click.command(hidden=True)
@click.option("--connect", "endpoint", required=True, metavar="ENDPOINT")
@click.option("--map", "map_name", required=True, metavar="NAME")
@click.option("--world", required=True)
@click.option("--poses", type=WholeNumber(2), required=True)
@click.option("--seed", type=int, required=True)
@click.option("--until-eof", is_flag=True)
def command(endpoint: str, map_name: str, world: str, poses: int, seed: int, until_eof: bool) -> None:
    """Drive through WORLD, inserting pose by pose into a map; print what it measured as JSON."""
    import threading

    from factorbus.cli.driving.drive import insert_steps
    from factorbus.cli.driving.remote import RemoteMap
    from factorbus.cli.output.console import document
    from factorbus.cli.process.stopping import leave_on_eof
    from factorbus.client import connect
    from factorbus.simulate import WORLDS

    if until_eof:
        threading.Thread(target=leave_on_eof, daemon=True).start()
    with connect(endpoint, client="robot") as bus, bus.map(map_name) as joined:
        target = RemoteMap(joined)
        driven = insert_steps(target, (step.batch for step in WORLDS[world.replace("-", "_")](poses=poses, seed=seed)))
        document(driven.measures() | target.summary())
        target.close()
