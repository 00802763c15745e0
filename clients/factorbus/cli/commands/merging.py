"""`factorbus change merge`: another map into this one."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from factorbus.cli.output.advice import MERGING, advising
from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import OK, input_file
from factorbus.cli.process.options import PATH, MapAddress, grouped
from factorbus.wording import counted


@dataclass(frozen=True, slots=True)
class MergeOptions:
    """How OTHER goes into NAME, as typed: see the help of each."""

    source: str | None
    letters: tuple[str, ...]
    kinds: tuple[str, ...]
    anchors: tuple[tuple[str, str, str], ...]
    frame: str | None
    sigmas: str | None
    absolute: str
    candidates: Path | None


@grouped("merging", MergeOptions)
@click.argument("other")
@click.option("--from", "source", metavar="ENDPOINT", help="The service that has OTHER.  [default: that of --connect]")
@click.option("--letter", "letters", multiple=True, metavar="OLD=NEW", help="Keys of OTHER get another letter: x=y.")
@click.option("--kind", "kinds", multiple=True, metavar="OLD=NEW", help="Own kinds of OTHER get another name.")
@click.option(
    "--anchor",
    "anchors",
    nargs=3,
    multiple=True,
    metavar="POSE OTHERS Z",
    help="Where the other map's pose (its new key) is, seen from one of NAME: x,y,theta or x,y,z,qx,qy,qz,qw.",
)
@click.option("--frame", metavar="T", help="Where the origin of OTHER is in NAME, if there is no anchor; as above.")
@click.option(
    "--sigmas",
    metavar="S",
    help="Standard deviations of anchors or frame: 0.1,0.1,0.05; in space six, metres then radians.",
)
@click.option(
    "--absolute",
    type=click.Choice(["refuse", "leave-out", "keep"]),
    default="refuse",
    show_default=True,
    help="What OTHER knows of its own frame, beyond where it begins.",
)
@click.option(
    "--align",
    "candidates",
    type=PATH,
    metavar="FILE",
    help="Candidates, of which many may be false: a line POSE OTHERS Z [SIGMAS] for each, numbers as for --anchor.",
)
def merge_command(address: MapAddress, other: str, merging: MergeOptions, settle: bool, as_json: bool) -> int:
    """Take all of map OTHER into NAME: its keys renamed, in NAME's frame, held by the anchors. OTHER stays as it is.

    All of it happens or none. One fixed pose, or one prior of a pose, is what a map has to begin with, and is left out.
    More than that (positions, headings, more priors) would be wrong in another frame: it is refused, left out with
    `--absolute leave-out`, or kept with `--absolute keep` if both maps have one frame.

    \b
    factorbus change merge hall robot2 --letter x=y --anchor x5 y8 0,2,-1.57 --sigmas 0.1,0.1,0.05 --settle
    factorbus change merge hall yard --from tcp/10.0.0.7:7447 --letter x=z --frame 12,-3,0.5 --sigmas 1,1,0.1
    factorbus change merge hall yard --letter x=z --align matches.txt --sigmas 0.1,0.1,0.05

    `--align` finds the largest set of candidates that agree, by what was measured and what both maps know of their
    poses, and merges by these if the set is no coincidence and no other set of half its size says something else.
    """
    from factorbus.cli.process.bus import open_bus
    from factorbus.client import align
    from factorbus.client.renaming_kinds import rename_kinds

    sigmas, file, found = merging.sigmas, merging.candidates, None
    if file is not None and (merging.anchors or merging.frame):
        raise click.UsageError("--align finds out what --anchor and --frame say; give one of them")
    candidates = None if file is None else read_candidates(file, sigmas)
    how: dict[str, Any] = {
        "letters": dict(_pair("--letter", each, "x=y") for each in merging.letters),
        "anchors": _draft(merging.anchors, sigmas) if merging.anchors else None,
        "frame": _numbers("--frame", merging.frame) if merging.frame else None,
        "sigmas": _numbers("--sigmas", sigmas) if sigmas and file is None else None,
        "absolute": merging.absolute.replace("-", "_"),
    }
    endpoint, zenoh, timeout_s = address.endpoint, address.zenoh, address.timeout_s
    with (
        open_bus(endpoint, "change", zenoh, timeout_s) as bus,
        open_bus(merging.source or endpoint, "change", zenoh, timeout_s) as there,
        there.map(other, mirror=False, create=False) as theirs,
        advising(MERGING),
        bus.map(address.name, mirror=False, create=False) as joined,
    ):
        graph = theirs.graph(timeout_s)
        if candidates is not None:
            found = align(joined, theirs, candidates, letters=how["letters"], timeout_s=timeout_s)
            how["anchors"] = found.anchors()
        graph = rename_kinds(graph, dict(_pair("--kind", each, "wheel=wheel_2") for each in merging.kinds))
        merged = joined.merge(graph, settle=settle, **how)
    _show(merged, found, as_json)
    return OK


def _show(merged: Any, found: Any, as_json: bool) -> None:
    accepted, fitted = merged.accepted, merged.fitted
    counted = {
        "variables": fitted.batch.variable_count,
        "factors": fitted.batch.factor_count,
        "anchors": fitted.anchors,
        **{f"left_out_{kind}": count for kind, count in fitted.left_out.items()},
    }
    chi2 = accepted.report.get("chi2", float("nan"))
    if as_json:
        frame = fitted.frame.tolist()
        where = {"revision": accepted.revision, "first_factor": accepted.first_factor, "chi2": chi2, "frame": frame}
        agreeing = {} if found is None else {"agree": found.agree.tolist(), "alignment": found.verdict}
        document(where | counted | agreeing)
        return
    if found is not None:
        print(found)
    rows = [(what.replace("_", " "), str(count)) for what, count in counted.items()]
    where = " ".join(f"{number:.4g}" for number in fitted.frame)
    table([*rows, ("its origin", where), ("χ²", f"{chi2:.6g}")], title=f"At revision {accepted.revision}")


def read_candidates(file: Path, sigmas: str | None) -> Any:
    """Of each line a relative pose.  Raises UsageError, Stopped."""
    from factorbus.client import Draft

    draft, usual = Draft(), None if sigmas is None else _numbers("--sigmas", sigmas)
    with input_file(file):
        text = file.read_text(encoding="utf-8")
    for number, line in enumerate(text.splitlines(), 1):
        fields = line.partition("#")[0].split()
        if not fields:
            continue
        where = f"{file}, line {number}"
        if len(fields) not in (3, 4):
            raise click.UsageError(
                f"{where} has {counted(len(fields), 'field')}; wanted POSE OTHERS Z [SIGMAS]: x5 y8 0,2,-1.57"
            )
        z, own = _numbers(where, fields[2]), usual if len(fields) == 3 else _numbers(where, fields[3])
        kind = _kind_of_pose(where, fields[2], z)
        if own is None:
            raise click.UsageError(f"{where} does not say how certain it is; give --sigmas, or a fourth field")
        draft.factor(kind, fields[:2], z, sigmas=own)
    return draft


def _draft(anchors: tuple[tuple[str, str, str], ...], sigmas: str | None) -> Any:
    from factorbus.client import Draft

    if sigmas is None:
        raise click.UsageError("--anchor says where, and nothing how certain; give --sigmas")
    draft = Draft()
    for here, there, measured in anchors:
        z = _numbers("--anchor", measured)
        kind = _kind_of_pose("--anchor", measured, z)
        draft.factor(kind, (here, there), z, sigmas=_numbers("--sigmas", sigmas))
    return draft


def _kind_of_pose(where: str, text: str, z: list[float]) -> str:
    """The kind of factor that a relative pose of 3 or 7 numbers is.  Raises UsageError."""
    if len(z) not in (3, 7):
        raise click.UsageError(f"{where}: {text} is {counted(len(z), 'number')}; wanted x,y,theta or x,y,z,qx,qy,qz,qw")
    return "between_se2" if len(z) == 3 else "between_se3"


def _numbers(option: str, text: str) -> list[float]:
    try:
        return [float(each) for each in text.split(",")]
    except ValueError:
        raise click.UsageError(f"{option} is {text!r}; wanted numbers with commas between: 0,2,-1.57") from None


def _pair(option: str, text: str, example: str) -> tuple[str, str]:
    old, equals, new = text.partition("=")
    if not equals:
        raise click.UsageError(f"{option} is {text!r}; wanted OLD=NEW, such as {example}")
    return old, new
