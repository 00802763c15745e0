"""Write the poses of a graph as a TUM trajectory: `timestamp tx ty tz qx qy qz qw`, as evo and others read it."""

import math
import os
from pathlib import Path
from typing import TextIO

from factorbus.formats.errors import FormatError
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import format_symbol, symbol_parts


def write_tum(path_or_file: str | os.PathLike[str] | TextIO, batch: Batch) -> None:
    """Write the poses of `batch`, in the order of their keys, to a path or an open text file.

    The time stamp is the index of the key (x12 → 12), or the place in the order when two keys share an index.  2D
    poses lie in the plane z = 0.  Points are left out.  Raises FormatError for a pose without a value.
    """
    text = tum_text(batch)
    if isinstance(path_or_file, str | os.PathLike):
        Path(path_or_file).write_text(text, encoding="ascii")
    else:
        path_or_file.write(text)


def tum_text(batch: Batch) -> str:
    """The same as text."""
    poses: dict[int, list[float]] = {}
    for group in batch.variables:
        if group.kind in ("se2", "se3"):
            if group.values is None:
                raise FormatError(
                    "TUM", None, f"{format_symbol(int(group.keys[0]))} has no value", "a value for every pose"
                )
            lift = _lifted if group.kind == "se2" else list
            poses.update(zip(group.keys.tolist(), map(lift, group.values.tolist()), strict=True))
    keys = sorted(poses)
    stamps = [symbol_parts(key)[1] for key in keys]
    if len(set(stamps)) < len(stamps):
        stamps = list(range(len(keys)))
    rows = sorted(zip(stamps, (poses[key] for key in keys), strict=True), key=lambda row: row[0])
    return "".join(f"{stamp} {' '.join(map(repr, pose))}\n" for stamp, pose in rows)


def _lifted(pose: list[float]) -> list[float]:
    """(x, y, theta) in the plane z = 0 of 3D."""
    x, y, theta = pose
    return [x, y, 0.0, 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)]
