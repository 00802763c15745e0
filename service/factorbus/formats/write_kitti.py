"""Write the poses of a graph as a KITTI trajectory: a line per pose, its 3 x 4 matrix [R t] row by row."""

import os
from collections.abc import Sequence
from pathlib import Path

from factorbus.formats.trajectory import Stamped, one_trajectory, write_trajectories
from factorbus.proto.messages import Batch


def write_kitti(path: str | os.PathLike[str], batch: Batch, robot: str | None = None) -> list[Path]:
    """Write the poses of `robot`, or a file for each robot (`trajectory.write_trajectories`); gives the files.

    The form has no time stamps: two files are compared line by line.  Axes stay those of the map.  Raises FormatError
    for a pose without a value, SeveralRobots for a robot that there is not.
    """
    return write_trajectories(Path(path), batch, "KITTI", _text, robot)


def kitti_text(batch: Batch, robot: str | None = None) -> str:
    """The trajectory of `robot`, or of the only one, as text.  Raises FormatError, SeveralRobots."""
    return _text(one_trajectory(batch, "KITTI", robot))


def _text(rows: list[Stamped]) -> str:
    return "".join(f"{' '.join(map(repr, _matrix(pose)))}\n" for *_, pose in rows)


def _matrix(pose: Sequence[float]) -> list[float]:
    """[R t] row by row of x y z qx qy qz qw."""
    tx, ty, tz, x, y, z, w = pose
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), tx,
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), ty,
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), tz,
    ]  # fmt: skip
