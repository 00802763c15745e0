"""From the lines of one record to numbers: all at once, and one by one only when something is wrong."""

import re
import warnings

import numpy as np

from factorbus.formats.errors import FormatError, refuse_first
from factorbus.formats.lines import Bucket
from factorbus.proto.arrays import F64, I64
from factorbus.proto.symbols import MAX_KEY
from factorbus.wording import counted

_NUMBER = re.compile(rb"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_EXACT = 2.0**53  # integers below are exact as floats


def read_numbers(file: str, name: str, bucket: Bucket, ids: int, width: int, fields: str) -> tuple[I64, F64]:
    """(ids, numbers) of all lines of a record that has `width` fields of which the first are `ids` ids.

    out  ids (n, ids)   numbers (n, width - ids), finite
    Raises FormatError, with the first line at fault and `fields` as what was wanted there.
    """
    table = _bulk(bucket, width)
    if table is None:
        table = _line_by_line(file, name, bucket, width, fields)
    lines = np.array(bucket.numbers, np.int64)
    refuse_first(
        file,
        lines,
        ~np.isfinite(table).all(axis=1),
        lambda row: f"{name} with a number that is not finite",
        "finite numbers",
    )
    heads = table[:, :ids]
    if not ((heads >= 0) & (heads < _EXACT) & (heads == np.floor(heads))).all():
        return _ids_one_by_one(file, name, bucket, ids), table[:, ids:]
    return heads.astype(np.int64), table[:, ids:]


def _bulk(bucket: Bucket, width: int) -> F64 | None:
    """All lines in one conversion; None when any line is not `width` plain numbers."""
    if any(len(rest.split()) != width for rest in bucket.rests):
        return None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # numpy before 2.3 warns where later ones raise
            flat = np.fromstring(b" ".join(bucket.rests), sep=" ")
    except (ValueError, DeprecationWarning):
        return None
    # Every line has `width` fields and nothing was left over: as many numbers as fields means one number a field.
    return flat.reshape(-1, width) if flat.size == width * len(bucket.rests) else None


def _line_by_line(file: str, name: str, bucket: Bucket, width: int, fields: str) -> F64:
    """The same, naming the first line that is not as it should be."""
    rows = []
    for rest, line in zip(bucket.rests, bucket.numbers, strict=True):
        found = rest.split()
        if len(found) != width:
            raise FormatError(file, line, f"{name} with {counted(len(found), 'field')}", f"{width}: {fields}")
        rows.append([_number(file, line, name, word) for word in found])
    return np.array(rows, np.float64).reshape(-1, width)


def _number(file: str, line: int, name: str, word: bytes) -> float:
    if not _NUMBER.fullmatch(word):
        raise FormatError(file, line, f"{name} with {_shown(word)}", "a finite number such as 1, -0.5 or 2e-3")
    return float(word)


def _ids_one_by_one(file: str, name: str, bucket: Bucket, ids: int) -> I64:
    """Ids that are too large for a float, or wrong."""
    table = np.empty((len(bucket.rests), ids), np.int64)
    for row, (rest, line) in enumerate(zip(bucket.rests, bucket.numbers, strict=True)):
        for column, word in enumerate(rest.split(None, ids)[:ids]):
            if not (word.isdigit() and len(word) < 20 and int(word) <= MAX_KEY):
                raise FormatError(file, line, f"{name} with id {_shown(word)}", f"a whole number from 0 to {MAX_KEY}")
            table[row, column] = int(word)
    return table


def _shown(word: bytes) -> str:
    text = word.decode("ascii", "backslashreplace")
    return repr(text if len(text) <= 40 else text[:37] + "...")
