"""`factorbus simulate`: a world with a robot in it, as a file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.exits import output_file
from factorbus.cli.process.options import FOLDER, WORLDS, WholeNumber, json_option, out_option
from factorbus.wording import counted


@click.command()
@click.argument("world", type=click.Choice((*WORLDS, "inertial")))
@click.option("--poses", type=WholeNumber(2, 1_000_000), default=3500, show_default=True, metavar="N")
@click.option("--seed", type=WholeNumber(0), default=1, show_default=True, help="The same seed, the same world.")
@out_option("--out", "out", "What the robot measured; a .jrl has the truth as well.", "FILE.g2o|.pyfg|.jrl|.cbor")
@click.option(
    "--folder",
    type=FOLDER,
    metavar="DIR",
    help="Of inertial, in place of --out: an EuRoC folder, which `replay` reads.",
)
@out_option("--truth", "truth", "Where it really was, in TUM form.", "FILE.tum")
@json_option
def command(
    world: str, poses: int, seed: int, out: Path | None, folder: Path | None, truth: Path | None, as_json: bool
) -> None:
    """Drive a robot through WORLD and write what it measured.

    \b
    manhattan    a drive on a street grid, with loop closures (SE2)
    city-trees   the same streets, with trees seen as landmarks (SE2 and points)
    sphere       round and round a sphere (SE3)
    inertial     an IMU, GNSS and a camera's odometry; where camera and antenna are on the robot, and where the map is
                 on the Earth, are to be found out; what is true of it is in truth.json beside (SE3, two poses a second)

    The file has no initial estimate but that of the first pose, which is fixed: the reader composes the others from
    the measurements, as `factorbus replay` does.

    \b
    factorbus simulate manhattan --poses 10000 --out m10k.g2o --truth m10k.tum
    factorbus replay m10k.g2o
    factorbus simulate inertial --poses 200 --folder drive
    factorbus replay drive --plot drive.png
    """
    if world == "inertial":
        _inertial(poses, seed, out, folder, truth)
        if as_json:
            _document(world, poses, seed, [folder, truth], notes=[], left_out={})
        return
    if folder is not None:
        raise click.UsageError(f"--folder is of inertial; {world} is one file: --out FILE.g2o")
    if out is None and truth is None:
        raise click.UsageError("there is nothing to write: give --out FILE.g2o, --truth FILE.tum or both")
    from factorbus.cli.driving.columns import merged
    from factorbus.cli.output import console as screen
    from factorbus.cli.process.reading import ROBOT_LOGS, say, told_of
    from factorbus.formats import FileNotes, RobotLog, write_graph, write_tum
    from factorbus.proto.messages import Batch

    batches, truths, notes = [], [], FileNotes()
    with screen.progress(world, poses) as show:
        for number, step in enumerate(_steps(world, poses, seed), 1):
            batches.append(step.batch)
            truths.append(Batch(step.truth))
            if number % 1000 == 0 or number == poses:
                show(number, "")
    if out:
        graph = merged(batches)
        with output_file(out):
            log = RobotLog(world, (), merged(truths).variables) if out.suffix in ROBOT_LOGS else None
            notes = write_graph(out, graph, ids="counted", log=log)  # ids of a .g2o that every program reads
        say(out, notes)
        screen.print_note(f"{out}: {counted(poses, 'pose')}, {counted(graph.factor_count, 'factor')}")
    if truth:
        with output_file(truth):
            write_tum(truth, merged(truths))
        screen.print_note(f"{truth}: {counted(poses, 'pose')}, as they are")
    if as_json:
        _document(world, poses, seed, [out, truth], **told_of(notes))


def _document(world: str, poses: int, seed: int, files: list[Path | None], **more: Any) -> None:
    from factorbus.cli.output.console import document

    document({"world": world, "poses": poses, "seed": seed, "files": [str(each) for each in files if each], **more})


def _inertial(poses: int, seed: int, out: Path | None, folder: Path | None, truth: Path | None) -> None:
    if folder is None or out is not None:
        raise click.UsageError("what sensors measure is no graph: give --folder DIR in place of --out")
    from factorbus.cli.logs.euroc import read_euroc
    from factorbus.cli.logs.write_euroc import write_world
    from factorbus.cli.output import console as screen
    from factorbus.formats import write_tum
    from factorbus.proto.messages import Batch
    from factorbus.simulate import inertial

    with output_file(folder):
        files = write_world(folder, inertial(poses, seed))
    screen.print_note(
        f"{folder}: {counted(poses, 'pose')}, {', '.join(str(each.relative_to(folder)) for each in files)}"
    )
    if truth:
        with output_file(truth):
            write_tum(truth, Batch(read_euroc(folder / "mav0").steps().truth()))
        screen.print_note(f"{truth}: {counted(poses, 'pose')}, as they are")


def _steps(world: str, poses: int, seed: int) -> Iterator[Any]:
    from factorbus.simulate import WORLDS as DRIVES

    return DRIVES[world.replace("-", "_")](poses=poses, seed=seed)
