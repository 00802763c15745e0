"""The files of a replay: the map, its trajectory, its picture; and a line that says what was written where."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from factorbus.cli.output.exits import output_file
from factorbus.cli.process.reading import ROBOT_LOGS, say
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.formats import FileNotes


@dataclass(frozen=True, slots=True)
class AskedFiles:
    """The files that were asked for; strict: refuse what would be left out of `out`."""

    out: Path | None
    tum: Path | None
    kitti: Path | None
    plot: Path | None
    strict: bool


@dataclass(frozen=True, slots=True)
class ReplayedDrive:
    """The map, the file that was read, its steps, what came of them, and the ground truth that the file has."""

    target: Any
    source: Any
    steps: Any
    driven: Any
    truth: Any


def write_files(asked: AskedFiles, title: str, drive: ReplayedDrive) -> tuple[list[Path], "FileNotes"]:
    """(the files, what was left out of them).  Raises Stopped, FormatError."""
    from factorbus.cli.driving.places import places_only
    from factorbus.cli.output.console import print_note
    from factorbus.formats import FileNotes, tum_notes, write_graph, write_kitti, write_tum
    from factorbus.proto.messages import Batch

    files, notes = list[Path](), FileNotes()
    if asked.out:
        graph, numbering = drive.target.graph(), drive.source.numbering
        ids = numbering if numbering != "ids" else "auto"
        with output_file(asked.out):
            notes = write_graph(asked.out, graph, asked.strict, ids, _truth_of(drive.source, asked.out))
        notes = notes.and_those(drive.target.closures_out())
        say(asked.out, notes)
        count = f"{counted(graph.variable_count, 'variable')}, {counted(graph.factor_count, 'factor')}"
        print_note(f"{asked.out}: the map written, {count}")
        files.append(asked.out)
    places = Batch(places_only(drive.target.estimate(), drive.steps)) if asked.tum or asked.kitti else Batch()
    for path, write, left in ((asked.tum, write_tum, tum_notes), (asked.kitti, write_kitti, None)):
        if path:
            files += _trajectories(path, write, places)
            untold = left(places) if left else FileNotes()
            say(path, untold)
            notes = notes.and_those(untold)
    if asked.plot:
        with output_file(asked.plot):
            _draw(asked.plot, title, drive)
        print_note(f"{asked.plot}: the picture written")
        files.append(asked.plot)
    return files, notes


def _trajectories(path: Path, write: Callable[..., list[Path]], places: Any) -> Sequence[Path]:
    """Of several robots each has a file of its own."""
    from factorbus.cli.output.console import print_note

    with output_file(path):
        files = write(path, places)
    if files == [path]:
        print_note(f"{path}: the trajectory written")
    else:
        print_note(f"{path}: one file for each robot written: {', '.join(map(str, files))}")
    return files


def _truth_of(source: Any, out: Path) -> Any:
    """Of the log that was read what a file of the map can have: a map has no labels of factors."""
    return replace(source.log, labels=()) if source.log and out.suffix in ROBOT_LOGS else None


def _draw(path: Path, title: str, drive: ReplayedDrive) -> None:
    from factorbus.cli.driving.aligned_truth import aligned_truth
    from factorbus.cli.driving.picture import draw, history_of
    from factorbus.cli.driving.places import places_only

    reports = [step.report for step in drive.driven.steps]
    estimate = places_only(drive.target.estimate(), drive.steps)
    history = history_of(reports, drive.target.compared())
    draw(path, drive.steps, estimate, history, title, truth=aligned_truth(drive.truth, estimate))
