"""Graph files as commands read them: the options, and one place where what was left out is said."""

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from factorbus.cli.output.exits import BAD_FILE, Stopped

if TYPE_CHECKING:
    from factorbus.cli.logs.sensor_log import SensorLog
    from factorbus.formats import FileNotes, GraphFile

F = TypeVar("F", bound=Callable[..., Any])

# The graph formats that are read; `tests/clients/test_cli_files.py` holds them to the reader's own list.
DIALECTS = ("g2o", "toro", "isam", "slam++", "pyfg", "jrl", "tum", "bal", "glim", "colmap", "nuscenes")
COUNTED = (("poses", "pose"), ("landmarks", "landmark"), ("factors", "factor"))  # of a graph, and of one of them
IDS = ("auto", "ids", "keys", "counted")
GRAPHS = (".g2o", ".pyfg", ".jrl", ".cbor")  # endings of files with the whole graph; others are trajectories
ROBOT_LOGS = (".jrl", ".cbor")  # those that have ground truth and labels beside it; a .jrl.cbor is a .jrl in CBOR

_RECORDINGS, _METADATA, _COMPRESSED = (".mcap", ".db3", ".bag"), "metadata.yaml", ".zstd"


def reading_options(command: F) -> F:
    """--dialect and --strict."""
    for option in (
        click.option("--strict", is_flag=True, help="Refuse what would otherwise be left out and said."),
        click.option(
            "--dialect",
            type=click.Choice(DIALECTS),
            help="What the file is written in.  [default: as its records say; a guess is said]",
        ),
    ):
        command = option(command)
    return command


def robot_option(command: F) -> F:
    """--robot."""
    return click.option(
        "--robot",
        metavar="LETTER",
        help='Write the trajectory of this robot alone ("" for keys without a letter).  [default: a file for each]',
    )(command)


def check_chosen(target: Path, robot: str | None, ids: str | None) -> None:
    """Raises UsageError where --robot or --ids is not of such a file."""
    if robot is not None and target.suffix in GRAPHS:
        raise click.UsageError(f"--robot is of trajectories: a {target.suffix} has the whole graph")
    if ids is not None and target.suffix != ".g2o":
        instead = f"a {target.suffix} has the keys themselves" if target.suffix in GRAPHS else "a trajectory has times"
        raise click.UsageError(f"--ids is of a .g2o: {instead}")


def read_graph(path: Path, dialect: str | None = None, strict: bool = False, whole: bool = False) -> "GraphFile":
    """The graph in `path`; what was left out, assumed or changed is said on standard error.

    whole: it is not to be replayed, so `strict` does not mind what no step would have.  Raises FormatError, Stopped.
    """
    from factorbus.formats import read

    if dialect is None and (what := _driven(path)):
        advice = f"factorbus replay {shlex.quote(str(path))} --in-process --out map.g2o makes one of it"
        raise Stopped("bad_file", f"{path}: {what}; wanted a graph: {advice}", BAD_FILE, path=str(path))

    graph = read(path, dialect, strict, whole)
    say(path, graph.notes)
    return graph


def _driven(path: Path) -> str:
    """What a path is that is driven and is no graph; empty: it may be one."""
    if is_recording(path):
        return "a robot's recording"
    from factorbus.cli.logs.recognize import has_log

    return "a log of an IMU" if has_log(path) else ""


def read_drive(path: Path, dialect: str | None = None, strict: bool = False) -> "GraphFile | SensorLog":
    """The same of what can be driven: also a folder with a log of sensors.  Raises FormatError."""
    if dialect is None and path.exists():
        from factorbus.cli.logs.recognize import is_log, read_log

        if is_log(path):
            log = read_log(path)
            say(path, log.notes)
            return log
    return read_graph(path, dialect, strict)


def is_recording(path: Path) -> bool:
    """Whether it is one by its name: a folder of rosbag2 or a file in it, or a file that ends as recordings do."""
    if not path.is_dir():
        ending = Path(path.stem).suffix if path.suffix == _COMPRESSED else path.suffix
        return path.name == _METADATA or ending in _RECORDINGS
    return (path / _METADATA).is_file() or any(each.suffix in _RECORDINGS[:2] for each in path.iterdir())


def told_of(notes: "FileNotes") -> dict[str, Any]:
    """For `--json`: what was left out of the files that were written, as `read` says it of one that was read."""
    return {"notes": list(notes), "left_out": dict(notes.counts)}


def say(path: Path, notes: tuple[str, ...]) -> None:
    """FileNotes on a file, to standard error."""
    from factorbus.cli.output.console import print_note

    for text in notes:
        print_note(f"{path}: {text}")
