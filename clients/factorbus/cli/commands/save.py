"""`factorbus save`: a map of a service as a file."""

from pathlib import Path
from typing import TYPE_CHECKING

import click

from factorbus.cli.output.exits import REFUSED, Stopped, output_file
from factorbus.cli.process.options import (
    PATH,
    checked_output,
    connect_option,
    json_option,
    timeout_option,
    zenoh_option,
)
from factorbus.cli.process.reading import GRAPHS, IDS, ROBOT_LOGS, check_chosen, say, told_of

if TYPE_CHECKING:
    from factorbus.client import Map

_WRITES = (*GRAPHS, ".tum", ".kitti")


@click.command()
@click.argument("name", metavar="MAP")
@click.argument("target", type=PATH, callback=checked_output, metavar="FILE")
@click.option("--robot", metavar="LETTER", help="The trajectory of this robot alone: the letter of its poses' keys.")
@click.option(
    "--ids",
    type=click.Choice(IDS),
    help="Of a .g2o: ids, without letters; keys, as GTSAM packs symbols; counted, 0 1 2 ...  "
    "[default: ids where x and l are all the letters, else keys]",
)
@connect_option
@zenoh_option
@timeout_option(60)
@json_option
def command(
    name: str,
    target: Path,
    robot: str | None,
    ids: str | None,
    endpoint: str,
    zenoh: str,
    timeout_s: float,
    as_json: bool,
) -> None:
    """Write MAP as it is now into FILE: the whole graph as .g2o, .pyfg, .jrl or .jrl.cbor, or trajectories as .tum
    or .kitti, by its ending. What has no place in FILE is left out and said; --json has it in "notes", and counted by
    kind in "left_out".

    A trajectory is of one robot, the letter of its poses' keys. Of several each gets a file of its own: out.tum becomes
    out-a.tum and out-b.tum. Its times are the poses' time stamps, and where no pose has one the numbers of their keys;
    a pose without one among others that have one is left out, and that is said.

    \b
    factorbus save warehouse warehouse.g2o
    factorbus save warehouse counted.g2o --ids counted
    factorbus save warehouse warehouse.pyfg
    factorbus save warehouse way.tum --robot a
    """
    if target.suffix not in _WRITES:
        raise click.BadParameter(f"{target} does not end in {', '.join(_WRITES)}", param_hint="FILE")
    check_chosen(target, robot, ids)
    from factorbus.cli.output.console import document
    from factorbus.cli.process.bus import open_bus
    from factorbus.cli.process.closures_out import closures_out
    from factorbus.formats import FileNotes, recoded, write_whole

    form = "jrl" if target.suffix in ROBOT_LOGS else target.suffix.removeprefix(".")
    with open_bus(endpoint, "save", zenoh, timeout_s) as bus, bus.map(name, mirror=False, create=False) as joined:
        robots = [] if target.suffix in GRAPHS else _robots(joined, robot)
        texts = (
            {letter: joined.ask.export(form, timeout_s, letter).result() for letter in robots}
            if robots
            else {"": joined.ask.export(form, timeout_s, ids=ids or "auto").result()}
        )
        notes = closures_out(joined, timeout_s) if target.suffix in GRAPHS else FileNotes()
    say(target, notes)
    files = []
    for letter, exported in texts.items():
        path = target if len(texts) == 1 else target.with_name(f"{target.stem}-{letter or 'none'}{target.suffix}")
        with output_file(path):
            write_whole(path, recoded(exported.text) if path.suffix == ".cbor" else exported.text)
        files.append(str(path))
        say(path, exported.notes)
        notes = notes.and_those(FileNotes(exported.notes, exported.left_out))
        if not as_json:
            click.echo(path)
    if as_json:
        document({"map": name, "files": files, **told_of(notes)})


def _robots(joined: "Map", robot: str | None) -> list[str]:
    """The letters of the robots to write; "" for keys without one; mounts and frames are none.  Raises Stopped."""
    from factorbus.proto.roles import poses_aside
    from factorbus.proto.symbols import symbol_parts

    groups = [group.keys for group in joined.ask_estimate().variables if group.kind in ("se2", "se3")]
    poses = {key for keys in groups for key in keys.tolist()}
    there = sorted({symbol_parts(key)[0] for key in poses})
    if len(there) > 1:  # only the factors tell what is no place
        poses -= set(poses_aside(joined.graph().batch).tolist())
        there = sorted({symbol_parts(key)[0] for key in poses})
    if robot is None:
        return there
    if robot not in there:
        told = ", ".join(letter or "keys without a letter" for letter in there) or "no pose"
        verb = "is" if len(there) < 2 and there != [""] else "are"
        raise Stopped("several_robots", f"map {joined.name!r} has no robot {robot!r}; there {verb} {told}", REFUSED)
    return [robot]
