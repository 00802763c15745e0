"""`factorbus export`: a map as one file, or all maps of a journal."""

from pathlib import Path

import click

from factorbus.cli.process.options import journal_option
from factorbus.proto.keys import checked_name


@click.command()
@click.argument("name", metavar="[MAP]", required=False)
@journal_option
@click.option(
    "--all", "every_map", is_flag=True, help="Each map of the journal, as MAP.fbmap in the folder --out.  A backup."
)
@click.option(
    "--out",
    type=click.Path(path_type=Path),
    metavar="PATH",
    help="The file, or with --all the folder.  [default: MAP.fbmap here; here]",
)
def command(name: str | None, folder: Path, every_map: bool, out: Path | None) -> None:
    """Copy MAP out of a service's journal into one file: every insert, clients' places, the newest checkpoint.

    Also while the service is at work: the file has the map as it was at one moment; its revision is printed. To move a
    map, `factorbus import` the file where it is to be, and drop the old one at that revision: if somebody inserted
    meanwhile it stays, and you begin again (deploy/README.md).

    With --all each map is copied that way, in place of a file of the same name once its copy is whole. A map that
    cannot be read is said, the others are copied, and the exit code is 1.

    \b
    factorbus export warehouse --journal /var/lib/factorbus
    factorbus export warehouse --journal /var/lib/factorbus --out /backup/warehouse-monday.fbmap
    factorbus export --all --journal /var/lib/factorbus --out /backup/monday
    """
    from factorbus.cli.output.exits import Stopped

    if every_map == (name is not None):
        raise click.UsageError("name a MAP, or say --all")
    if out is not None and not out.absolute().parent.is_dir():
        raise click.UsageError(f"there is no folder {out.absolute().parent}; make it first")
    if out is not None and out.exists() and out.is_dir() != every_map:
        raise click.UsageError(f"{out} is {'a folder; wanted a file' if out.is_dir() else 'a file; wanted a folder'}")
    if name is not None:
        _export(folder, checked_name("map", name), out or Path(f"{name}.fbmap"))
        return
    failed = _export_all(folder, out or Path())
    if failed:
        raise Stopped("not_all_exported", f"not copied: {', '.join(failed)}; what is wrong is said above", maps=failed)


def _export(folder: Path, name: str, file: Path) -> None:
    from factorbus.journal.bundle import export_map

    revision = export_map(folder / name, file)
    click.echo(f"{file}: revision {revision}, {file.stat().st_size / 1e6:.1f} MB")


def _export_all(folder: Path, out: Path) -> list[str]:
    """The names of those that could not be."""
    from factorbus.cli.output.console import print_note
    from factorbus.journal.folders import maps_in
    from factorbus.journal.problems import NoJournal
    from factorbus.journal.store import NAME
    from factorbus.proto.problems import Problem

    if not folder.is_dir():
        raise NoJournal(folder)
    out.mkdir(parents=True, exist_ok=True)
    failed = []
    for name in maps_in(folder, NAME):
        try:
            _export(folder, name, out / f"{name}.fbmap")
        except Problem as problem:
            failed.append(name)
            print_note(f"{name}: {problem}")
    return failed
