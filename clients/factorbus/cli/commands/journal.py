"""`factorbus journal`: what is on disk of a service's maps, if it is sound, and if it gives the same again."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output import console as screen
from factorbus.cli.output.exits import FAILED, OK, report, require
from factorbus.cli.process.options import journal_option, json_option
from factorbus.wording import counted

_MAP = click.argument("names", nargs=-1, metavar="[MAP ...]")

_NEXT = (
    "restore its folder from a copy, or give it up with `factorbus drop {name} --damaged` and `factorbus import` an "
    "exported file; what only makes it slower to open needs nothing"
)


@click.group()
def command() -> None:
    """The journals of `factorbus serve --journal DIR`. They are only read, also while a service is at work.

    \b
    factorbus journal show --journal /var/lib/factorbus
    factorbus journal check --journal /var/lib/factorbus
    factorbus journal verify warehouse --journal /var/lib/factorbus
    """


@command.command()
@_MAP
@journal_option
@json_option
def show(names: tuple[str, ...], folder: Path, as_json: bool) -> int:
    """What there is of MAP, or of every map. One that does not open hides no other; the exit code is then 5, or 3 where
    it may not be read."""
    from factorbus.proto.problems import Problem

    rows, code = list[dict[str, Any]](), OK
    for name in _names(folder, names):
        try:
            with _open(folder / name) as store:
                rows.append({"map": name, **_row(store)})
        except Problem as problem:
            code = report(problem, as_json=False, debug=False)
            rows.append({"map": name, "code": problem.code, "problem": problem.message})
    if as_json:
        screen.document({"maps": rows})
    for row in () if as_json else rows:
        cells = [("does not open", row["code"])] if "code" in row else list(row.items())[1:]
        screen.table([(key, _in_words(value)) for key, value in cells], title=row["map"])
    return code


def _in_words(value: Any) -> str:
    """A value of a row as a person reads it: lists with commas, the parts of a build by name."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ("; " if any(isinstance(each, dict) for each in value) else ", ").join(map(_in_words, value)) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_in_words(each)}" for name, each in value.items())
    return "none" if value in (None, "") else str(value)


def _row(store: Any) -> dict[str, Any]:
    header, last, saved, makers = store.header(), store.last(), store.checkpoints(), store.makers()
    return {
        "mode": header.mode,
        "epoch": header.epoch,
        "revision": last.revision,
        **store.counts(),
        "checkpoints": [each.record for each in saved],
        "durability": header.durability,
        "epochs": [epoch.because for epoch in header.epochs],
        "closed_in_order": header.clean,
        "builds": [{"from_record": maker.record, **maker.build} for maker in makers],
        "differs": next((each.differs for each in saved), ""),
    }


@command.command()
@_MAP
@journal_option
@json_option
def check(names: tuple[str, ...], folder: Path, as_json: bool) -> int:
    """Is it sound: the database, every insert's bytes, every client's numbers, every checkpoint? Exit code 1: no."""
    found = {name: list(_wrong_with(folder / name)) for name in _names(folder, names)}
    if as_json:
        screen.document({"maps": [{"map": name, "sound": not wrong, "wrong": wrong} for name, wrong in found.items()]})
    for name, wrong in () if as_json else found.items():
        click.echo(f"{name}: {'sound' if not wrong else 'NOT SOUND'}")
        for each in wrong:
            click.echo(f"  {each}")
        if wrong:
            click.echo(f"  {_NEXT.format(name=name)}")
    return FAILED if any(found.values()) else OK


def _wrong_with(folder: Path) -> Iterator[str]:
    """What is wrong with the journal in `folder`, also where it does not open."""
    from factorbus.journal.checkpoints import file_of, read_checkpoint
    from factorbus.proto.problems import Problem

    try:
        with _open(folder) as store:
            yield from store.check()
            for saved in store.checkpoints():
                try:
                    read_checkpoint(file_of(store.path.parent, saved.record))
                except (OSError, ValueError) as error:
                    yield f"{error}; the map opens without it, and takes longer"
    except Problem as problem:
        yield str(problem.detail.get("what") or problem.message)


@command.command()
@_MAP
@journal_option
@json_option
def verify(names: tuple[str, ...], folder: Path, as_json: bool) -> int:
    """Apply everything again, from the first insert on: is every revision the same, to the bit? Exit code 1: no.

    Another processor, or another version of factorbus, may well round otherwise: then the first revision is named at
    which the values differ.
    """
    require("service", "factorbus journal verify")
    from factorbus.proto.problems import Problem

    rows, code = list[dict[str, Any]](), OK
    for name in _names(folder, names):
        try:
            with _open(folder / name) as store:
                rows.append({"map": name, **_verified(name, store)})
        except Problem as problem:
            rows.append({"map": name, "code": problem.code, "problem": problem.message})
            code = report(problem, as_json=False, debug=False)
        if not as_json:
            click.echo(_told(rows[-1]))
    if as_json:
        screen.document({"maps": rows})
    return code or (FAILED if any(row.get("differs_from") for row in rows) else OK)


def _told(row: dict[str, Any]) -> str:
    name = row["map"]
    if "code" in row:
        return f"{name}: cannot be verified"
    if row["differs_from"] is not None:
        return f"{name}: values differ from revision {row['differs_from']} on (of {row['revision']})"
    return (
        f"{name}: {counted(row['records'], 'record')}, {counted(row['revision'], 'revision')}, all the same to the bit"
    )


def _verified(name: str, store: Any) -> dict[str, Any]:
    """From which revision on it differs, if any.  Raises JournalDamaged, JournalDiffers, JournalOption."""
    from factorbus.service.config import Limits
    from factorbus.service.journal.library import make_map_solver
    from factorbus.service.journal.recovery import verify as run_again

    header, total = store.header(), store.last().record
    again = make_map_solver(header.mode, header.options, header.epoch, Limits())
    revision, differs = 0, 0
    with screen.progress(name, total) as show_progress:
        for record, same in run_again(store, again):
            revision = record.revision
            differs = differs or (0 if same else revision)
            show_progress(record.number, f"revision {revision}")
    return {"records": total, "revision": revision, "differs_from": differs or None}


def _names(folder: Path, names: tuple[str, ...]) -> tuple[str, ...]:
    """`names`, or those of all maps in `folder`.  Raises NoJournal."""
    from factorbus.journal.folders import maps_in
    from factorbus.journal.problems import NoJournal
    from factorbus.journal.store import NAME

    there = tuple(maps_in(folder, NAME)) if folder.is_dir() else ()
    if not there:
        raise NoJournal(folder)
    for name in names:
        if name not in there:
            raise NoJournal(folder / name, there)
    return names or there


@contextmanager
def _open(folder: Path) -> Iterator[Any]:
    from factorbus.journal.store import open_store

    store = open_store(folder, read_only=True)
    try:
        yield store
    finally:
        store.close()
