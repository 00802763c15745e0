"""Read a TUM trajectory: `timestamp tx ty tz qx qy qz qw`, the time in seconds, which keeps every nanosecond.

A number of seconds since 1970 with nine decimals has more digits than a float, so it is never made one.
"""

import re
from collections.abc import Mapping
from decimal import Decimal

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.graph import GraphFile
from factorbus.formats.lines import Bucket
from factorbus.formats.numbers import read_numbers
from factorbus.formats.rotations import normalized_poses
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.stamps import LEAST_STAMP, MOST_STAMP
from factorbus.proto.symbols import symbol

TUM = "tum"
_SECONDS = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")
_POSE = "TUM pose"


def is_trajectory(buckets: Mapping[str, Bucket]) -> bool:
    """Whether the first line of a file begins with a number: records of graphs begin with a name."""
    first = min(buckets, key=lambda name: buckets[name].numbers[0])
    return _SECONDS.fullmatch(first) is not None


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
    poses = Bucket([rest for _, _, rest in rows], [line for line, _, _ in rows])
    stamps = np.array([_nanoseconds(file, line, time) for line, time, _ in rows], np.int64)
    _, values = read_numbers(file, _POSE, poses, 0, 7, "tx ty tz qx qy qz qw after the time")
    lines: I64 = np.array(poses.numbers, np.int64)
    values = np.ascontiguousarray(normalized_poses(file, _POSE, lines, values))
    keys = symbol("x", 0) + np.arange(len(rows))
    return GraphFile(file, TUM, Batch((Variables("se3", keys, values, False, stamps),)), ())


def _nanoseconds(file: str, line: int, time: str) -> int:
    seconds = Decimal(time) if _SECONDS.fullmatch(time) else Decimal("NaN")
    if seconds.is_finite() and seconds.adjusted() < 12:  # more digits than an int64 has need not be written out
        stamp = int((seconds * 10**9).to_integral_value())
        if LEAST_STAMP <= stamp <= MOST_STAMP:
            return stamp
    shown = time if len(time) <= 40 else time[:37] + "..."
    wanted = "seconds such as 1403636579.763555584, of magnitude below 9223372036.854775808"
    raise FormatError(file, line, f"a time of {shown!r}", wanted)
