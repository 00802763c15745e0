"""`factorbus drop`: take a map off its service, for good."""

import click

from factorbus.cli.process.options import WholeNumber, connect_option, json_option, timeout_option, zenoh_option


@click.command()
@click.argument("name", metavar="MAP")
@click.option(
    "--revision",
    type=WholeNumber(0),
    metavar="N",
    help="Only if the map is at this revision and nothing is under way: what `factorbus export` said.",
)
@click.option(
    "--damaged",
    is_flag=True,
    help="A map that is on the disk of the service and does not open (`journal_damaged`, ...): give up what is there.",
)
@connect_option
@zenoh_option
@timeout_option(30)
@json_option
def command(
    name: str, revision: int | None, damaged: bool, endpoint: str, zenoh: str, timeout_s: float, as_json: bool
) -> None:
    """Drop MAP, with its journal. With --revision it stays when somebody inserted meanwhile: `moved_on`, exit code 5.

    The last step of moving a map: what was copied is all there is. Where access control is on, ask as an operator.

    With --damaged what the service could not open is removed from its disk, so that the name is free again; an open map
    stays (`not_damaged`). Copy its folder first if somebody may want to look at it.

    \b
    factorbus drop old-survey
    factorbus drop hall --damaged
    factorbus drop shard0-hall --revision 4711 --connect tls/router.local:7447 --zenoh ops.json5
    """
    from factorbus.cli.output.console import document
    from factorbus.cli.process.bus import open_bus

    with open_bus(endpoint, "drop", zenoh, timeout_s) as bus:
        bus.drop(name, revision=revision, damaged=damaged)
    if as_json:
        document({"map": name, "dropped": True})
    else:
        click.echo(f"{name} is gone")
