"""`factorbus change attach`: a part of a map into the frame of the rest."""

from pathlib import Path

import click

from factorbus.cli.commands.merging import read_candidates
from factorbus.cli.output.advice import ATTACHING, advising
from factorbus.cli.output.console import document, table
from factorbus.cli.output.exits import OK
from factorbus.cli.process.options import PATH, MapAddress


@click.argument("letters")
@click.argument("candidates", type=PATH)
@click.option(
    "--sigmas",
    metavar="S",
    help="Standard deviations of lines without their own: 0.1,0.1,0.05; in space six, metres then radians.",
)
@click.option(
    "--absolute",
    type=click.Choice(["refuse", "leave-out"]),
    default="refuse",
    show_default=True,
    help="What the part knows of its own frame, beyond where it begins.",
)
def attach_command(
    address: MapAddress,
    letters: str,
    candidates: Path,
    sigmas: str | None,
    absolute: str,
    settle: bool,
    as_json: bool,
) -> int:
    """Bring the variables of NAME whose keys have LETTERS into the frame of the rest, if CANDIDATES say where they are.

    A robot that does not know where it is begins in a frame of its own, under a letter of its own. CANDIDATES is a text
    file of relative poses between both parts, of which many may be false: a line POSE POSE Z [SIGMAS] for each, where Z
    is x,y,theta or x,y,z,qx,qy,qz,qw. Those that agree hold the part from then on. If too few do, or two sets say two
    things, nothing changes.

    \b
    factorbus change attach hall b matches.txt --sigmas 0.1,0.1,0.05 --settle
    """
    from factorbus.cli.process.bus import joined_map
    from factorbus.client import attach

    given = read_candidates(candidates, sigmas)
    with joined_map(address, "change") as joined, advising(ATTACHING):
        came = attach(
            joined, letters, given, absolute=absolute.replace("-", "_"), settle=settle, timeout_s=address.timeout_s
        )
        anchors = came.alignment.anchors()  # raises where they do not say it
    accepted, frame = came.accepted, came.alignment.frame
    if accepted is None or frame is None:
        raise RuntimeError("what is aligned was not inserted")
    counted = {"anchors": anchors.factor_count, **{f"left_out_{kind}": n for kind, n in came.left_out.items()}}
    chi2 = accepted.report.get("chi2", float("nan"))
    if as_json:
        where = {"revision": accepted.revision, "first_factor": accepted.first_factor, "chi2": chi2}
        agreeing = {"agree": came.alignment.agree.tolist(), "alignment": came.alignment.verdict}
        document(where | {"frame": frame.tolist()} | counted | agreeing)
        return OK
    print(came.alignment)
    rows = [(what.replace("_", " "), str(count)) for what, count in counted.items()]
    placed = " ".join(f"{number:.4g}" for number in frame)
    table([*rows, ("its origin", placed), ("χ²", f"{chi2:.6g}")], title=f"At revision {accepted.revision}")
    return OK
