"""`factorbus export`: a map as one file."""

from pathlib import Path

import click

from factorbus.cli.process.options import journal_option, out_option
from factorbus.proto.keys import checked_name


@click.command()
@click.argument("name", metavar="MAP")
@journal_option
@out_option("--out", "out", "The file.  [default: MAP.fbmap here]", "FILE")
def command(name: str, folder: Path, out: Path | None) -> None:
    """Copy MAP out of a service's journal into one file: every insert, clients' places, the newest checkpoint.

    Also while the service is at work: the file has the map as it was at one moment; its revision is printed. To move a
    map, `factorbus import` the file where it is to be, and drop the old one at that revision: if somebody inserted
    meanwhile it stays, and you begin again (deploy/README.md).

    \b
    factorbus export warehouse --journal /var/lib/factorbus
    factorbus export warehouse --journal /var/lib/factorbus --out /backup/warehouse-monday.fbmap
    """
    from factorbus.journal.bundle import export_map

    file = out or Path(f"{checked_name('map', name)}.fbmap")
    revision = export_map(folder / checked_name("map", name), file)
    click.echo(f"{file}: revision {revision}, {file.stat().st_size / 1e6:.1f} MB")
