"""`factorbus export`: a map as one file, or all maps of a journal."""

from pathlib import Path
from typing import Any

import click

from factorbus.cli.process.options import PATH, journal_option, json_option
from factorbus.proto.keys import checked_name


@click.command()
@click.argument("name", metavar="[MAP]", required=False)
@journal_option
@click.option(
    "--all", "every_map", is_flag=True, help="Each map of the journal, as MAP.fbmap in the folder --out.  A backup."
)
@click.option(
    "--out",
    type=PATH,
    metavar="PATH",
    help="The file, or with --all the folder.  [default: MAP.fbmap here; here]",
)
@json_option
def command(name: str | None, folder: Path, every_map: bool, out: Path | None, as_json: bool) -> int:
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
    from factorbus.cli.output.console import document
    from factorbus.cli.output.exits import FAILED, OK, Stopped

    if every_map == (name is not None):
        raise click.UsageError("name a MAP, or say --all")
    if out is not None and not out.absolute().parent.is_dir():
        raise click.UsageError(f"there is no folder {out.absolute().parent}; make it first")
    if out is not None and out.exists() and out.is_dir() != every_map:
        raise click.UsageError(f"{out} is {'a folder; wanted a file' if out.is_dir() else 'a file; wanted a folder'}")
    if name is not None:
        rows = [_export(folder, checked_name("map", name), out or Path(f"{name}.fbmap"), as_json)]
    else:
        rows = _export_all(folder, out or Path(), as_json)
    failed = [row["map"] for row in rows if "problem" in row]
    if as_json:
        document({"maps": rows})
        return FAILED if failed else OK
    if failed:
        raise Stopped("not_all_exported", f"not copied: {', '.join(failed)}; what is wrong is said above", maps=failed)
    return OK


def _export(folder: Path, name: str, file: Path, as_json: bool) -> dict[str, Any]:
    from factorbus.journal.bundle import export_map

    revision, size = export_map(folder / name, file), file.stat().st_size
    if not as_json:
        click.echo(f"{file}: revision {revision}, {size / 1e6:.1f} MB")
    return {"map": name, "file": str(file), "revision": revision, "bytes": size}


def _export_all(folder: Path, out: Path, as_json: bool) -> list[dict[str, Any]]:
    """A row for each map; of one that could not be copied it has the problem."""
    from factorbus.cli.output.console import print_note
    from factorbus.journal.folders import maps_in
    from factorbus.journal.problems import NoJournal
    from factorbus.journal.store import NAME
    from factorbus.proto.problems import Problem

    if not folder.is_dir():
        raise NoJournal(folder)
    out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in maps_in(folder, NAME):
        try:
            rows.append(_export(folder, name, out / f"{name}.fbmap", as_json))
        except Problem as problem:
            rows.append({"map": name, "problem": {"code": problem.code, "message": problem.message}})
            print_note(f"{name}: {problem}")
    return rows
