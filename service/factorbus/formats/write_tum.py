"""Write the poses of a graph as a TUM trajectory: `timestamp tx ty tz qx qy qz qw`, as evo and others read it."""

import os
from pathlib import Path

from factorbus.formats.trajectory import Stamped, one_trajectory, write_trajectories
from factorbus.proto.messages import Batch


def write_tum(path: str | os.PathLike[str], batch: Batch, robot: str | None = None) -> list[Path]:
    """Write the poses of `robot`, or a file for each robot (`trajectory.write_trajectories`); gives the files.

    Raises FormatError for a pose without a value, SeveralRobots for a robot that there is not.
    """
    return write_trajectories(Path(path), batch, "TUM", _text, robot)


def tum_text(batch: Batch, robot: str | None = None) -> str:
    """The trajectory of `robot`, or of the only one, as text.  Raises FormatError, SeveralRobots."""
    return _text(one_trajectory(batch, "TUM", robot))


def _text(rows: list[Stamped]) -> str:
    return "".join(f"{stamp} {' '.join(map(repr, pose))}\n" for stamp, pose in rows)
