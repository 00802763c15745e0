"""The poses of a graph in the order of time, one trajectory for each robot, as trajectory files list them."""

import math
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from factorbus.formats.errors import FormatError
from factorbus.formats.left_out import shown
from factorbus.formats.whole_file import write_whole
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.problems import SeveralRobots
from factorbus.proto.roles import poses_aside
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol, symbol_parts
from factorbus.wording import counted

_VALUED = "a value for every pose: solve it first, as `factorbus replay FILE --{option} OUT` does"


class Stamped(NamedTuple):
    """A pose, x y z qx qy qz qw: its key, the key's number (x12 → 12), and its time stamp in nanoseconds, if any."""

    key: int
    number: int
    stamp: int | None
    pose: list[float]


def trajectories(batch: Batch, form: str) -> dict[str, list[Stamped]]:
    """The poses of each robot of `batch`, in the order of time, by its letter ("" for keys without one).

    A robot is the letter of its keys.  Its order is that of the time stamps where all its poses have one, else that of
    the numbers of its keys, which of a key without a letter is all of it.  2D poses lie in the plane z = 0.  Points are
    left out, and so are poses that are no places in the map (`factorbus.proto.roles`).  Raises FormatError, which
    speaks of `form`, for a pose without a value.
    """
    robots: dict[str, list[Stamped]] = defaultdict(list)
    aside = set(poses_aside(batch).tolist())
    for group in batch.variables:
        if group.kind in ("se2", "se3"):
            if group.values is None:
                wanted = _VALUED.format(option=form.lower())
                raise FormatError(form, None, f"{format_symbol(int(group.keys[0]))} has no value", wanted)
            lift = _lifted if group.kind == "se2" else list
            rows = zip(group.keys.tolist(), _stamps(group).tolist(), group.values.tolist(), strict=True)
            for key, stamp, value in rows:
                if key in aside:
                    continue
                letter, number = symbol_parts(key)
                robots[letter].append(Stamped(key, number, None if stamp == NO_STAMP else stamp, lift(value)))
    return {letter: _in_order(robots[letter]) for letter in sorted(robots)}


def one_trajectory(batch: Batch, form: str, robot: str | None = None) -> list[Stamped]:
    """The poses of `robot`, a letter or ""; of the only robot without it.

    Raises FormatError, SeveralRobots: there are others, and none was chosen, or the one chosen is not among them.
    """
    found = trajectories(batch, form)
    if robot is None and len(found) <= 1:
        return next(iter(found.values()), [])
    if robot not in found:
        raise SeveralRobots(robot, tuple(found))
    return found[robot]


def untimed(rows: list[Stamped]) -> list[Stamped]:
    """The poses without a time stamp of a trajectory in which others have one: there is no time to give them."""
    missing = [row for row in rows if row.stamp is None]
    return missing if len(missing) < len(rows) else []


def untimed_note(rows: list[Stamped]) -> str:
    """What is to be said of those, for people; empty: there are none."""
    missing = untimed(rows)
    if not missing:
        return ""
    names, has = shown([format_symbol(row.key) for row in missing]), "has" if len(missing) == 1 else "have"
    return f"{counted(len(missing), 'pose')} left out: {names} {has} no time stamp, and others have one"


def write_trajectories(
    path: Path, batch: Batch, form: str, text: Callable[[list[Stamped]], str], robot: str | None
) -> list[Path]:
    """Write the trajectory of `robot`, or of every robot into a file of its own, and give the files.

    The one robot's is `path`; of several each has its letter added: out.tum becomes out-a.tum and out-b.tum, and stays
    out.tum for keys without a letter.  Raises FormatError, SeveralRobots, OSError; nothing is written before both.
    """
    if robot is not None:
        found = {"": one_trajectory(batch, form, robot)}
    else:
        found = trajectories(batch, form)
        if len(found) <= 1:
            found = {"": next(iter(found.values()), [])}
    files = []
    for letter, rows in found.items():
        file = path.with_name(f"{path.stem}-{letter}{path.suffix}") if letter else path
        write_whole(file, text(rows), encoding="ascii")
        files.append(file)
    return files


def _stamps(group: Variables) -> I64:
    return group.keys * 0 + NO_STAMP if group.stamps is None else group.stamps


def _in_order(rows: list[Stamped]) -> list[Stamped]:
    if any(row.stamp is None for row in rows):
        return sorted(rows, key=lambda row: row.number)
    return sorted(rows, key=lambda row: (row.stamp, row.number))


def _lifted(pose: list[float]) -> list[float]:
    """(x, y, theta) in the plane z = 0 of 3D."""
    x, y, theta = pose
    return [x, y, 0.0, 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)]
