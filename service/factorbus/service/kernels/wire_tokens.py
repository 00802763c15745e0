"""The tokens of the wire as a table for kernels: what readers look up and writers copy.

`TOKENS` has a row for each, `LETTERS` their bytes one after the other.  The rows of kinds and losses are made from the
solver's tables, so a new one needs nothing here.
"""

import numpy as np

from factorbus.service.kernels.compile import I64, U8, inline_kernel
from factorbus.solver.graph.factors import FACTOR_KINDS, LOSSES
from factorbus.solver.graph.variables import VARIABLE_KINDS

# Columns of `TOKENS`.
W_ROLE = 0
W_CODE = 1  # of a field or a piece: below; of a kind: the solver's code
W_START = 2  # in `LETTERS`
W_LENGTH = 3
W_ARITY = 4
W_SIZE = 5
W_TRIANGLE = 6
W_NIL = 7  # of a field: whether nil is the same as no such field
W_WIDTH = 8

# Roles.
PIECE = 0
IN_INSERT = 1
IN_VARIABLES = 2
IN_FACTORS = 3
VARIABLE_KIND = 4
FACTOR_KIND = 5
LOSS_NAME = 6

# Codes of the fields of an insert, and of those of a group.
SEQUENCE, EPOCH, SETTLE, CONVERT_BELOW, VARIABLES, FACTORS = range(6)
KIND, KEYS, NUMBERS, INFORMATION, SCALE, STAMPS, IDS, FIXED, LOSS = range(9)
GROUP_FIELDS = 9

# What stands between the numbers of the messages that are written; a piece's code is its row.
_PIECES = (
    b"\x86\xa8sequence",
    b"\xa5epoch",
    b"\xa8revision",
    b"\xacfirst_factor",
    b"\xa7applied",
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

_MAY_BE_NIL = {"values", "stamps", "scale", "loss"}

# The longest string that MessagePack gives a head of one byte; others are no tokens.
LONGEST = 31


def _table() -> tuple[I64, U8]:
    insert = ("sequence", "epoch", "settle", "convert_below", "variables", "factors")
    variables = {"kind": KIND, "keys": KEYS, "values": NUMBERS, "stamps": STAMPS, "fixed": FIXED}
    factors = {
        "kind": KIND, "keys": KEYS, "measured": NUMBERS, "information": INFORMATION, "scale": SCALE, "ids": IDS,
        "loss": LOSS,
    }  # fmt: skip
    rows: list[tuple[bytes, int, int, tuple[int, ...]]] = []
    rows += [(piece, PIECE, code, ()) for code, piece in enumerate(_PIECES)]
    rows += [(name.encode(), IN_INSERT, code, ()) for code, name in enumerate(insert)]
    for role, fields in ((IN_VARIABLES, variables), (IN_FACTORS, factors)):
        rows += [(name.encode(), role, code, (0, 0, 0, name in _MAY_BE_NIL)) for name, code in fields.items()]
    rows += [(k.name.encode(), VARIABLE_KIND, k.code, (1, k.size)) for k in VARIABLE_KINDS.values()]
    rows += [
        (k.name.encode(), FACTOR_KIND, k.code, (len(k.connects), k.size, k.triangle)) for k in FACTOR_KINDS.values()
    ]
    rows += [(name.encode(), LOSS_NAME, code, ()) for name, code in LOSSES.items()]
    tokens, letters = np.zeros((len(rows), W_WIDTH), np.int64), b""
    for row, (name, role, code, sizes) in zip(tokens, rows, strict=True):
        row[: W_ARITY + len(sizes)] = role, code, len(letters), len(name), *sizes
        letters += name
    return tokens, np.frombuffer(letters, np.uint8).copy()


TOKENS, LETTERS = _table()


@inline_kernel
def look_up(raw: bytes, start: int, length: int, role: int) -> int:
    """The row of the word raw[start : start + length] among those of a role, or −1."""
    for row in range(TOKENS.shape[0]):
        if TOKENS[row, W_ROLE] == role and TOKENS[row, W_LENGTH] == length:
            same, k = True, 0
            while same and k < length:
                same = raw[start + k] == LETTERS[TOKENS[row, W_START] + k]
                k += 1
            if same:
                return row
    return -1


@inline_kernel
def row_of_variables(code: int) -> int:
    """The row of a kind of variables."""
    row = 0
    while TOKENS[row, W_ROLE] != VARIABLE_KIND or TOKENS[row, W_CODE] != code:
        row += 1
    return row
