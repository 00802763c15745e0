"""The words of the wire as a table for kernels: what readers look up and writers copy.

`WORDS` has a row for each, `LETTERS` their bytes one after the other.  The rows of kinds are made from the solver's
tables, so a new kind needs nothing here; sights are left out, whose lenses are looked at on the usual way.
"""

import numpy as np

from factorbus.service.kernels.compile import I64, U8, inline_kernel
from factorbus.solver.graph.factors import FACTOR_KINDS, LENS_AT
from factorbus.solver.graph.variables import VARIABLE_KINDS

# Columns of `WORDS`.
W_ROLE = 0
W_CODE = 1  # of a field or a piece: below; of a kind: the solver's code
W_START = 2  # in `LETTERS`
W_LENGTH = 3
W_ARITY = 4
W_SIZE = 5
W_TRIANGLE = 6
W_WIDTH = 7

# Roles.
PIECE = 0
IN_INSERT = 1
IN_GROUP = 2
VARIABLE_KIND = 3
FACTOR_KIND = 4

# Codes of the fields of an insert, and of those of a group.
SEQUENCE, EPOCH, SETTLE, VARIABLES, FACTORS = range(5)
KIND, KEYS, VALUES, FIXED, MEASURED, INFORMATION, STAMPS = range(7)

# What stands between the numbers of the messages that are written; a piece's code is its row.
_PIECES = (
    b"\x86\xa8sequence",
    b"\xa5epoch",
    b"\xa8revision",
    b"\xacfirst_factor",
    b"\xa7applied\x01",
    b"\xa6report",
    b"\x85\xa5epoch",
    b"\xa8previous",
    b"\xa9variables",
    b"\xa4kind",
    b"\xa4keys",
    b"\xa6values",
    b"\xa5fixed\xc3",
    b"\xa6stamps",
)
(
    P_SEQUENCE, P_EPOCH, P_REVISION, P_FIRST_FACTOR, P_APPLIED, P_REPORT, P_DELTA, P_PREVIOUS, P_VARIABLES, P_KIND,
    P_KEYS, P_VALUES, P_FIXED, P_STAMPS,
) = range(len(_PIECES))  # fmt: skip

# The longest string that MessagePack gives a head of one byte; others are no words.
LONGEST = 31


def _table() -> tuple[I64, U8]:
    insert = (b"sequence", b"epoch", b"settle", b"variables", b"factors")
    group = (b"kind", b"keys", b"values", b"fixed", b"measured", b"information", b"stamps")
    rows = [(piece, PIECE, code, 0, 0, 0) for code, piece in enumerate(_PIECES)]
    rows += [(name, IN_INSERT, code, 0, 0, 0) for code, name in enumerate(insert)]
    rows += [(name, IN_GROUP, code, 0, 0, 0) for code, name in enumerate(group)]
    rows += [(k.name.encode(), VARIABLE_KIND, k.code, 1, k.size, 0) for k in VARIABLE_KINDS.values()]
    quick = [kind for kind in FACTOR_KINDS.values() if kind.name not in LENS_AT]
    rows += [(k.name.encode(), FACTOR_KIND, k.code, len(k.connects), k.size, k.triangle) for k in quick]
    words, letters = np.zeros((len(rows), W_WIDTH), np.int64), b""
    for row, (name, role, code, *sizes) in zip(words, rows, strict=True):
        row[:] = role, code, len(letters), len(name), *sizes
        letters += name
    return words, np.frombuffer(letters, np.uint8).copy()


WORDS, LETTERS = _table()


@inline_kernel
def look_up(raw: bytes, start: int, length: int, role: int, words: I64, letters: U8) -> int:
    """The row of the word raw[start : start + length] among those of a role, or −1."""
    for row in range(words.shape[0]):
        if words[row, W_ROLE] == role and words[row, W_LENGTH] == length:
            same, k = True, 0
            while same and k < length:
                same = raw[start + k] == letters[words[row, W_START] + k]
                k += 1
            if same:
                return row
    return -1


@inline_kernel
def row_of_variables(code: int, words: I64) -> int:
    """The row of a kind of variables."""
    row = 0
    while words[row, W_ROLE] != VARIABLE_KIND or words[row, W_CODE] != code:
        row += 1
    return row
