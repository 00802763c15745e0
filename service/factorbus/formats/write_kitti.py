"""Write the poses of a graph as a KITTI trajectory: a line per pose, its 3 x 4 matrix [R t] row by row."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from factorbus.formats.trajectory import stamped_poses
from factorbus.proto.messages import Batch


def write_kitti(path_or_file: str | os.PathLike[str] | TextIO, batch: Batch) -> None:
    """Write the poses of `batch`, as `stamped_poses` orders them, to a path or an open text file.

    The form has no time stamps: two files are compared line by line.  Axes stay those of the map.  Raises FormatError.
    """
    text = kitti_text(batch)
    if isinstance(path_or_file, str | os.PathLike):
        Path(path_or_file).write_text(text, encoding="ascii")
    else:
        path_or_file.write(text)


def kitti_text(batch: Batch) -> str:
    """The same as text."""
    return "".join(f"{' '.join(map(repr, _matrix(pose)))}\n" for _, pose in stamped_poses(batch, "KITTI"))


def _matrix(pose: Sequence[float]) -> list[float]:
    """[R t] row by row of x y z qx qy qz qw."""
    tx, ty, tz, x, y, z, w = pose
    return [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), tx,
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), ty,
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), tz,
    ]  # fmt: skip
