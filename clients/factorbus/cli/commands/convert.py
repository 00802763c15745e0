"""`factorbus convert`: from one file format to another."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click

from factorbus.cli.output.exits import output_file
from factorbus.cli.process.options import PATH, file_argument, grouped, json_option
from factorbus.cli.process.reading import (
    COUNTED,
    GRAPHS,
    IDS,
    check_chosen,
    read_graph,
    reading_options,
    robot_option,
    say,
    told_of,
)
from factorbus.wording import counted

if TYPE_CHECKING:
    from factorbus.formats import FileNotes, GraphFile

_WRITES = (*GRAPHS, ".tum", ".kitti")


@dataclass(frozen=True, slots=True)
class ConvertOptions:
    """What else is read, and what is written: see the options of these names."""

    robot: str | None
    ids: str | None
    ground_truth: bool
    loops: Path | None


@click.command()
@grouped("options", ConvertOptions)
@file_argument("source")
@file_argument("target")
@reading_options
@robot_option
@click.option(
    "--ids",
    type=click.Choice(IDS),
    help="Of a .g2o: auto, as in SOURCE; ids, without letters; keys, as GTSAM packs symbols; counted, 0 1 2 ...  "
    "[default: auto]",
)
@click.option("--ground-truth", is_flag=True, help="Write the ground truth of a .jrl in place of its values.")
@click.option(
    "--loops", type=PATH, metavar="FILE",
    help="Of a SOURCE that is a trajectory: loop closures, lines of first second tx ty tz qx qy qz qw [sigma_m "
    "sigma_rad], poses by their place (0 1 2 ...) or time.",
)  # fmt: skip
@json_option
def command(
    source: Path, target: Path, dialect: str | None, strict: bool, options: ConvertOptions, as_json: bool
) -> None:
    """Read SOURCE (g2o, TORO .graph, iSAM, SLAM++, PyFactorGraph .pyfg, JRL .jrl or .jrl.cbor, BAL or TUM text, the
    folder of a map that GLIM has saved, or of a COLMAP model, nuScenes's ego_pose.json) and write TARGET (.g2o, .pyfg,
    .jrl, .jrl.cbor, .tum or .kitti, by its ending).

    What has no place in TARGET, or is not read, is left out and said. A trajectory is one robot's, and a robot is the
    letter of its keys: of several each gets a file of its own, out-a.tum, out-b.tum. A .tum has each pose's time stamp.
    With --ground-truth it is where the poses really were, which a .jrl may say.  With --loops a trajectory becomes a
    graph: odometry between its poses, with 2 % of the way as its error, and the closures.

    \b
    factorbus convert w10000.graph w10000.g2o
    factorbus convert estimate.g2o estimate.tum
    factorbus convert goats.pyfg goats.g2o
    factorbus convert ntu.jrl truth.tum --ground-truth
    factorbus convert ntu.jrl ntu.jrl.cbor
    factorbus convert two-robots.g2o a.tum --robot a
    factorbus convert dump map.g2o
    factorbus convert sparse/0 cameras.tum
    factorbus convert way.tum way.g2o --loops loops.txt
    factorbus convert edges.txt edges.g2o --dialect slam++
    """
    if target.suffix not in _WRITES:
        raise click.BadParameter(
            f"{target} does not end in {' or '.join((', '.join(_WRITES[:-1]), _WRITES[-1]))}", param_hint="TARGET"
        )
    robot, ids, ground_truth = options.robot, options.ids, options.ground_truth
    check_chosen(target, robot, ids)
    if ground_truth and target.suffix in GRAPHS:
        raise click.UsageError(f"--ground-truth is of trajectories: a {target.suffix} has the whole graph")
    from factorbus.cli.output.console import document, print_note

    graph = read_graph(source, dialect, strict, whole=True)
    if options.loops is not None:
        graph = _with_loops(graph, options.loops)
    graph = _of_truth(graph) if ground_truth else graph
    _check_any(graph, target)
    with output_file(target):
        files, notes, counts = _written(graph, target, strict, robot, ids or "auto")
    say(target, notes)
    if as_json:
        about = {"source": str(source), "read": graph.summary(whole=True), "files": [str(file) for file in files]}
        document({**about, **told_of(notes), **counts})
    told = ", ".join(counted(counts[many], one) for many, one in COUNTED)
    print_note(f"{', '.join(map(str, files))}: {told}")


def _with_loops(graph: "GraphFile", loops: Path) -> "GraphFile":
    """What was assumed is said.  Raises FormatError."""
    from factorbus.formats import with_loops

    joined = with_loops(graph, loops)
    say(Path(graph.path), joined.notes[len(graph.notes) :])
    return joined


def _of_truth(graph: "GraphFile") -> "GraphFile":
    """The poses alone, where they really were.  Raises FormatError."""
    from dataclasses import replace

    from factorbus.formats import FormatError
    from factorbus.proto.messages import Batch

    if graph.log is None or not graph.log.known:
        raise FormatError(graph.path, None, "no ground truth", "a .jrl with its groundtruth")
    return replace(graph, batch=Batch(graph.log.ground_truth), log=None)


def _check_any(graph: "GraphFile", target: Path) -> None:
    """Raises FormatError where nothing of `graph` would be in `target`."""
    from factorbus.formats import FormatError

    if target.suffix in GRAPHS and not (graph.batch.variable_count or graph.batch.factor_count):
        raise FormatError(
            graph.path, None, f"nothing that a {target.suffix} would have", "at least one vertex or edge that is read"
        )
    if target.suffix not in GRAPHS and not graph.poses:
        raise FormatError(graph.path, None, f"no pose, and a {target.suffix} has nothing else", "at least one pose")


def _without_left_out(counts: dict[str, int], notes: "FileNotes", graph: "GraphFile") -> dict[str, int]:
    """How much of `counts`, which are of the graph, is in a file that was written without what its notes count."""
    from factorbus.proto.kinds import name_of_kind

    of_kind = {
        "poses": {"se2", "se3", "mounts", "frames"},
        "landmarks": {"point2", "point3", "idp"},
        "factors": {name_of_kind(group.kind) for group in graph.batch.factors},
    }
    return {many: counts[many] - sum(notes.counts.get(name, 0) for name in of_kind[many]) for many in counts}


def _written(
    graph: "GraphFile", target: Path, strict: bool, robot: str | None, ids: str
) -> tuple[list[Path], "FileNotes", dict[str, int]]:
    """(the files, what was left out of them, how much is in them).  Raises FormatError, SeveralRobots."""
    from factorbus.formats import FileNotes, tum_notes, write_graph, write_kitti, write_tum
    from factorbus.formats.left_out import LeftOut
    from factorbus.formats.trajectory import one_trajectory, trajectories, untimed

    counts = {"poses": graph.poses, "landmarks": graph.landmarks, "factors": graph.batch.factor_count}
    if target.suffix in GRAPHS:
        same = graph.numbering if graph.numbering != "ids" else "auto"
        notes = write_graph(target, graph.batch, strict, same if ids == "auto" else ids, graph.log)
        return [target], notes, _without_left_out(counts, notes, graph)
    form = target.suffix[1:].upper()
    found = trajectories(graph.batch, form)
    chosen = [one_trajectory(graph.batch, form, robot)] if robot is not None else list(found.values())
    left = LeftOut(str(target))
    for name in ("landmarks", "factors"):
        left.drop(name, counts[name], "a trajectory has poses alone")
    if graph.log is not None and graph.log.known:
        left.drop("ground truth values", graph.log.known, "--ground-truth writes them in place of the others")
    left.drop("poses", graph.poses - sum(map(len, chosen)), f"of other robots than {robot!r}")
    write, notes = (write_tum, tum_notes) if form == "TUM" else (write_kitti, lambda *_: FileNotes())
    untold = sum(len(untimed(rows)) for rows in chosen) if form == "TUM" else 0
    written = {"poses": sum(map(len, chosen)) - untold, "landmarks": 0, "factors": 0}
    return write(target, graph.batch, robot), left.told().and_those(notes(graph.batch, robot)), written
