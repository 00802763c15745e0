"""Read a TUM trajectory: `timestamp tx ty tz qx qy qz qw`, the time in seconds, which keeps every nanosecond."""

from collections.abc import Mapping

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.graph import GraphFile
from factorbus.formats.lines import Bucket
from factorbus.formats.numbers import read_numbers
from factorbus.formats.rotations import normalized_poses
from factorbus.formats.seconds import is_time, nanoseconds
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol

TUM = "tum"
_POSE = "TUM pose"
_KITTI = 12  # numbers of a pose there: the upper three rows of a matrix


def is_trajectory(buckets: Mapping[str, Bucket]) -> bool:
    """Whether the first line of a file begins with a number: records of graphs begin with a name."""
    first = min(buckets, key=lambda name: buckets[name].numbers[0])
    return is_time(first)


def read_trajectory(file: str, buckets: Mapping[str, Bucket]) -> GraphFile:
    """The poses as x0, x1, ... in the order of the lines, each with its time stamp; there are no factors.

    buckets: lines by their first word, which is the time.  Decimals beyond nanoseconds are rounded to the nearest.
    Raises FormatError, which names the file and the line.
    """
    rows = sorted(
        (line, time, rest)
        for time, bucket in buckets.items()
        for line, rest in zip(bucket.numbers, bucket.rests, strict=True)
    )
    first = len(rows[0][2].split())
    if first == _KITTI - 1 or (file.endswith(".kitti") and first != 7):
        raise FormatError(file, rows[0][0], "a KITTI pose, which is written and not read", "a graph, or TUM's poses")
    poses = Bucket([rest for _, _, rest in rows], [line for line, _, _ in rows])
    stamps = np.array([nanoseconds(file, line, time) for line, time, _ in rows], np.int64)
    _, values = read_numbers(file, _POSE, poses, 0, 7, "tx ty tz qx qy qz qw after the time")
    lines: I64 = np.array(poses.numbers, np.int64)
    values = np.ascontiguousarray(normalized_poses(file, _POSE, lines, values))
    keys = symbol("x", 0) + np.arange(len(rows))
    return GraphFile(file, TUM, Batch((Variables("se3", keys, values, False, stamps),)), ())
