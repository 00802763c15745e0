"""Write the poses of a graph as a TUM trajectory: `timestamp tx ty tz qx qy qz qw`, as evo and others read it."""

import os
from pathlib import Path
from typing import TextIO

from factorbus.formats.trajectory import stamped_poses
from factorbus.proto.messages import Batch


def write_tum(path_or_file: str | os.PathLike[str] | TextIO, batch: Batch) -> None:
    """Write the poses of `batch`, as `stamped_poses` lists them, to a path or an open text file.

    Raises FormatError for a pose without a value.
    """
    text = tum_text(batch)
    if isinstance(path_or_file, str | os.PathLike):
        Path(path_or_file).write_text(text, encoding="ascii")
    else:
        path_or_file.write(text)


def tum_text(batch: Batch) -> str:
    """The same as text."""
    return "".join(f"{stamp} {' '.join(map(repr, pose))}\n" for stamp, pose in stamped_poses(batch, "TUM"))
