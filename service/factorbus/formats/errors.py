"""The one way in which a file can be refused."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.arrays import I64
from factorbus.proto.problems import Problem


class FormatError(Problem):
    """A file, or a graph that should become one, is not what it should be.

    file: its name; line: counted from 1, None where the fault is not of one line; `found` and `wanted` say the rest.
    """

    code = "bad_file"

    def __init__(self, file: str, line: int | None, found: str, wanted: str) -> None:
        self.file, self.line, self.found, self.wanted = file, line, found, wanted
        place = file if line is None else f"{file}:{line}"
        super().__init__(f"{place}: {found}; wanted {wanted}", file=file, line=line, seen=found, wanted=wanted)


def refuse_first(
    file: str, lines: I64, bad: NDArray[np.bool] | np.bool, found: Callable[[int], str], wanted: str
) -> None:
    """Raise FormatError for the first line (by number) whose row is `bad`; `found(row)` describes it.

    in   lines (n,) line numbers   bad (n,) bool
    """
    rows = np.flatnonzero(bad)
    if rows.size:
        row = int(rows[np.argmin(lines[rows])])
        raise FormatError(file, int(lines[row]), found(row), wanted)
