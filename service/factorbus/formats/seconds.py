"""Times as files have them, in seconds, and time stamps, in nanoseconds.

A number of seconds since 1970 with nine decimals has more digits than a float, so it is never made one.
"""

import re
from decimal import Decimal

from factorbus.formats.errors import FormatError
from factorbus.proto.stamps import LEAST_STAMP, MOST_STAMP

_SECONDS = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,3})?")


def is_time(text: str) -> bool:
    """Whether `text` is a number of seconds."""
    return _SECONDS.fullmatch(text) is not None


def nanoseconds(file: str, line: int, time: str) -> int:
    """The time stamp of `time`; decimals beyond nanoseconds are rounded to the nearest.  Raises FormatError."""
    seconds = Decimal(time) if is_time(time) else Decimal("NaN")
    if seconds.is_finite() and seconds.adjusted() < 12:  # more digits than an int64 has need not be written out
        stamp = int((seconds * 10**9).to_integral_value())
        if LEAST_STAMP <= stamp <= MOST_STAMP:
            return stamp
    shown = time if len(time) <= 40 else time[:37] + "..."
    wanted = "seconds such as 1403636579.763555584, of magnitude below 9223372036.854775808"
    raise FormatError(file, line, f"a time of {shown!r}", wanted)


def seconds_text(stamp: int) -> str:
    """A time stamp in seconds, to the nanosecond."""
    seconds, rest = divmod(abs(stamp), 10**9)
    return f"{'-' if stamp < 0 else ''}{seconds}.{rest:09d}"
