"""`factorbus import`: a map from one file."""

from pathlib import Path

import click

from factorbus.cli.process.options import file_argument, journal_option
from factorbus.proto.keys import checked_name


@click.command()
@file_argument("file")
@journal_option
@click.option("--as", "name", metavar="MAP", help="Its name here.  [default: that of the file]")
def command(file: Path, folder: Path, name: str | None) -> None:
    """Put the map that `factorbus export` wrote to FILE into a service's journal.

    It is checked first, and is there whole or not at all. A service that is at work lists it, and opens it when
    somebody lists maps, asks for it, joins it or drops it; one that starts, at once. Its epoch and the places of its
    clients come with it, so they go on where they were: see to it that the map has only one owner.

    \b
    factorbus import warehouse.fbmap --journal /var/lib/factorbus
    factorbus import /backup/warehouse-monday.fbmap --journal /var/lib/factorbus --as warehouse-restored
    """
    from factorbus.journal.bundle import import_map

    chosen = checked_name("map", name or file.stem)
    import_map(file, folder / chosen)
    click.echo(f"{folder / chosen}")
