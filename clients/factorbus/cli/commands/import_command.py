"""`factorbus import`: a map from one file."""

from pathlib import Path

import click

from factorbus.cli.process.options import PATH, journal_option, json_option
from factorbus.proto.keys import LONGEST_NAME, checked_name, is_name


@click.command()
@click.argument("files", metavar="FILE...", nargs=-1, required=True, type=PATH)
@journal_option
@click.option("--as", "name", metavar="MAP", help="Its name here, of one FILE.  [default: that of the file]")
@json_option
def command(files: tuple[Path, ...], folder: Path, name: str | None, as_json: bool) -> None:
    """Put the maps that `factorbus export` wrote to FILE, ... into a service's journal.

    Each is checked first, and is there whole or not at all. A service that is at work lists it, and opens it when
    somebody lists maps, asks for it, joins it or drops it; one that starts, at once. Its epoch and the places of its
    clients come with it, so they go on where they were: see to it that the map has only one owner.

    \b
    factorbus import warehouse.fbmap --journal /var/lib/factorbus
    factorbus import /backup/warehouse-monday.fbmap --journal /var/lib/factorbus --as warehouse-restored
    factorbus import /backup/monday/*.fbmap --journal /var/lib/factorbus
    """
    from factorbus.cli.output.console import document
    from factorbus.journal.bundle import import_map

    if name and len(files) > 1:
        raise click.UsageError("--as is for one FILE")
    for file in files:
        if not (name or is_name(file.stem)):
            wanted = f"a name of 1 to {LONGEST_NAME} of the characters A-Z a-z 0-9 _ -"
            raise click.UsageError(f"{file} has a name that no map can have; wanted {wanted}: --as MAP gives it one")
    rows = []
    for file, chosen in [(file, checked_name("map", name or file.stem)) for file in files]:
        import_map(file, folder / chosen)
        rows.append({"map": chosen, "file": str(file), "folder": str(folder / chosen)})
        if not as_json:
            click.echo(f"{folder / chosen}")
    if as_json:
        document({"maps": rows})
