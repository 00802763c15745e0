"""Write the poses of a graph as a TUM trajectory: `timestamp tx ty tz qx qy qz qw`, as evo and others read it."""

import os
from pathlib import Path

from factorbus.formats.left_out import FileNotes
from factorbus.formats.seconds import seconds_text
from factorbus.formats.trajectory import (
    Stamped,
    one_trajectory,
    trajectories,
    untimed,
    untimed_note,
    write_trajectories,
)
from factorbus.proto.messages import Batch


def write_tum(path: str | os.PathLike[str], batch: Batch, robot: str | None = None) -> list[Path]:
    """Write the poses of `robot`, or a file for each robot (`trajectory.write_trajectories`); gives the files.

    The time of a pose is its time stamp, in seconds with all its nanoseconds; of a robot without any, the number of
    the key.  Where some poses of a robot have a stamp, those without are left out, and `tum_notes` says which.
    Raises FormatError for a pose without a value, SeveralRobots for a robot that there is not.
    """
    return write_trajectories(Path(path), batch, "TUM", _text, robot)


def tum_text(batch: Batch, robot: str | None = None) -> str:
    """The trajectory of `robot`, or of the only one, as text.  Raises FormatError, SeveralRobots."""
    return _text(one_trajectory(batch, "TUM", robot))


def tum_notes(batch: Batch, robot: str | None = None) -> FileNotes:
    """What `write_tum` leaves out of the file of `robot`, or of all, for people.  Raises as it does."""
    chosen = trajectories(batch, "TUM").values() if robot is None else [one_trajectory(batch, "TUM", robot)]
    left = len([row for rows in chosen for row in untimed(rows)])
    return FileNotes((note for rows in chosen if (note := untimed_note(rows))), {"poses": left} if left else {})


def _text(rows: list[Stamped]) -> str:
    missing = {row.key for row in untimed(rows)}
    return "".join(f"{_time(row)} {' '.join(map(repr, row.pose))}\n" for row in rows if row.key not in missing)


def _time(row: Stamped) -> str:
    """Seconds, to the nanosecond; without a stamp the number of the key."""
    if row.stamp is None:
        return str(row.number)
    return seconds_text(row.stamp)
