"""Numbers in text files, row by row; what is wrong is said with its line."""

import re
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from factorbus.formats import FormatError
from factorbus.proto.arrays import F64, I64
from factorbus.wording.unreadable import mend_of

_NS = re.compile(r"(\d{4})-(\d\d)-(\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?$")


def text_of(path: Path, wanted: str) -> str:
    """Raises FormatError where there is no such file, or it is no text."""
    try:
        return path.read_text("utf-8")
    except (OSError, UnicodeDecodeError) as failure:
        reason = failure.strerror if isinstance(failure, OSError) and failure.strerror else "it is not text"
        mend = "; " + mend_of(failure) if isinstance(failure, OSError) else ""
        raise FormatError(str(path), None, f"it cannot be read ({reason})", wanted + mend) from failure


def rows_of_numbers(
    path: Path, columns: int, what: str, separator: str | None = ",", header: int = 0
) -> tuple[F64, I64]:
    """(rows (n, columns or more) as floats, their lines); what: the columns in words.

    separator: None for blanks.  header: lines to pass over; those that begin with # are passed over everywhere.
    Raises FormatError.
    """
    rows, lines = _cells(path, columns, what, separator, header)
    return np.array([_floats(path, line, row[:columns], what) for line, row in zip(lines, rows, strict=True)]), lines


def timed(path: Path, columns: int, what: str) -> tuple[I64, F64]:
    """(times (n,) in nanoseconds, increasing; the columns after it (n, columns)) of a .csv.  Raises FormatError."""
    rows, lines = _cells(path, columns + 1, f"time in ns, {what}", ",", 0)
    times = np.array([_nanoseconds(path, line, row[0]) for line, row in zip(lines, rows, strict=True)], np.int64)
    in_order(path, times, lines)
    return times, np.array(
        [_floats(path, line, row[1 : columns + 1], what) for line, row in zip(lines, rows, strict=True)]
    )


def in_order(path: Path, times: I64, lines: I64) -> None:
    """Raises FormatError for the first time that is not after the one before."""
    late = np.flatnonzero(np.diff(times) <= 0)
    if late.size:
        n = int(late[0]) + 1
        found = f"the time {times[n]} ns after {times[n - 1]} ns"
        raise FormatError(str(path), int(lines[n]), found, "times that increase")


def stamp_of_date(path: Path, line: int, text: str) -> int:
    """Nanoseconds of 2011-09-26 13:02:25.594360375.  Raises FormatError."""
    found = _NS.match(text.strip())
    if not found:
        raise FormatError(str(path), line, f"the time {text.strip()[:40]!r}", "such as 2011-09-26 13:02:25.594360375")
    try:
        whole = np.datetime64("{}-{}-{}T{}:{}:{}".format(*found.groups()[:6]), "s").astype(np.int64)
    except ValueError as failure:
        raise FormatError(str(path), line, f"the time {text.strip()[:40]!r}", "a date that there is") from failure
    return int(whole) * 10**9 + int((found[7] or "0").ljust(9, "0"))


def sensor_settings(path: Path, used: Collection[str]) -> Mapping[str, F64]:
    """The numbers of a sensor.yaml: those after `name:`, and matrices after `name:` as `data: [...]` or row by row.

    used: the names that are looked up; words in place of their numbers are refused, others are left out.
    Empty where there is no such file.  Raises FormatError.
    """
    if not path.exists():
        return {}
    text = re.sub(r"#.*", "", text_of(path, "a sensor.yaml"))
    found: dict[str, F64] = {}
    for name, body in re.findall(r"^(\w+):(.*?)(?=^\w|\Z)", text, re.MULTILINE | re.DOTALL):
        if name not in used:
            continue  # of no use here, such as a comment on the sensor
        line = text[: text.index(f"{name}:")].count("\n") + 1
        inside = re.search(r"data:\s*\[([^\]]*)\]", body)
        words = re.sub(r"[\[\],]|^\s*-(?=\s)", " ", inside[1] if inside else body, flags=re.MULTILINE).split()
        numbers = _floats(path, line, words, f"of {name}")
        if not numbers:
            raise FormatError(str(path), line, f"{name} without a number", f"the numbers of {name}")
        found[name] = np.array(numbers)
    return found


def _cells(path: Path, columns: int, what: str, separator: str | None, header: int) -> tuple[list[list[str]], I64]:
    rows, lines = list[list[str]](), list[int]()
    for line, text in enumerate(text_of(path, f"a table of {what}").splitlines(), 1):
        if line <= header or not text.strip() or text.lstrip().startswith("#"):
            continue
        row = text.split(separator)
        if len(row) < columns:
            raise FormatError(str(path), line, f"{len(row)} columns", f"{columns} ({what})")
        rows.append(row)
        lines.append(line)
    if not rows:
        raise FormatError(str(path), None, "no row at all", f"a table of {what}")
    return rows, np.array(lines, np.int64)


def _floats(path: Path, line: int, row: list[str], what: str) -> list[float]:
    try:
        numbers = [float(cell) for cell in row]
    except ValueError as failure:
        raise FormatError(str(path), line, str(failure)[:80], f"numbers ({what})") from failure
    if not np.isfinite(numbers).all():
        raise FormatError(str(path), line, "a number that is not finite", f"finite numbers ({what})")
    return numbers


def _nanoseconds(path: Path, line: int, word: str) -> int:
    if not word.strip().isdecimal() or len(word.strip()) > 19:
        raise FormatError(str(path), line, f"the time {word.strip()[:30]!r}", "nanoseconds, a whole number below 2^63")
    return min(int(word), 2**63 - 1)
