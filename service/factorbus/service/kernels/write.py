"""The answers to the inserts of a step and its delta, as bytes: those of `codec.encode_accepted` and `encode_delta`."""

import numpy as np

from factorbus.service.kernels import wire_tokens as w
from factorbus.service.kernels.compile import I64, U8, inline_kernel, kernel, part
from factorbus.service.kernels.wire_tokens import LETTERS, TOKENS
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.records import Graph, graph_at

# In place of the revision before a delta: there is none to write.
NO_DELTA = -1
# Entries of `step`.
EPOCH, REVISION, PREVIOUS = range(3)
# No message is longer than this but for its columns and its report; nor is what a group adds to its columns.
_MOST_HEAD, _MOST_GROUP = 128, 96


@kernel(
    "int64(int64[:,::1], int64[::1], Bytes(uint8, 1, 'C', readonly=True), int64[::1], int64[::1], uint8[::1],"
    " int64[::1])"
)
def write_messages(answers: I64, step: I64, report: bytes, changed: I64, graph_table: I64, out: U8, ends: I64) -> int:
    """Write the answers to the inserts of a step, one behind the other, and then its delta.

    Gives how much of `out` they take at most; where that is more than there is, nothing was written.

    answers (n, 2): of each insert its sequence number and the id of its first factor.  step (3,): epoch, revision, and
    the one before, or NO_DELTA.  report: encoded, in all of them.  changed: the variables that the delta tells of,
    ascending.  graph_table: of the graph's arrays (`records`).  out ends (n + 1,): where each message ends.
    """
    graph, inserts = graph_at(graph_table), len(answers)
    groups, stamped, columns = count_groups(changed, graph)
    size = (inserts + 1) * (_MOST_HEAD + len(report)) + columns + _MOST_GROUP * np.count_nonzero(groups)
    if size > out.size:
        return size
    here = 0
    for n in range(inserts):
        here = write_integer(out, write_piece(out, here, w.P_SEQUENCE), answers[n, 0])
        here = write_integer(out, write_piece(out, here, w.P_EPOCH), step[EPOCH])
        here = write_integer(out, write_piece(out, here, w.P_REVISION), step[REVISION])
        here = write_integer(out, write_piece(out, here, w.P_FIRST_FACTOR), answers[n, 1])
        here = write_integer(out, write_piece(out, here, w.P_APPLIED), inserts)
        here = write_bytes(out, write_piece(out, here, w.P_REPORT), report, 0, len(report))
        ends[n] = here
    if step[PREVIOUS] != NO_DELTA:
        here = write_integer(out, write_piece(out, here, w.P_DELTA), step[EPOCH])
        here = write_integer(out, write_piece(out, here, w.P_REVISION), step[REVISION])
        here = write_integer(out, write_piece(out, here, w.P_PREVIOUS), step[PREVIOUS])
        here = write_variables(out, write_piece(out, here, w.P_VARIABLES), groups, stamped, changed, graph)
        here = write_bytes(out, write_piece(out, here, w.P_REPORT), report, 0, len(report))
    ends[inserts] = here
    return size


@part
def count_groups(changed: I64, graph: Graph) -> tuple:
    """(how many there are of each kind, those that are not fixed before those that are; how many of them have a time
    stamp; bytes of their columns)."""
    kinds = 0
    for row in range(TOKENS.shape[0]):
        if TOKENS[row, w.W_ROLE] == w.VARIABLE_KIND:
            kinds = max(kinds, TOKENS[row, w.W_CODE] + 1)
    var, stamps = graph.var, graph.stamps
    groups, stamped, size = np.zeros(2 * kinds, np.int64), np.zeros(2 * kinds, np.int64), 0
    for n in range(changed.size):
        group = label_of_variable(changed[n], var)
        groups[group] += 1
        stamped[group] += 1 if stamps[changed[n]] != at.NO_STAMP else 0
    for group in range(groups.size):
        if groups[group] > 0:
            columns = 1 + TOKENS[w.row_of_variables(group // 2), w.W_SIZE] + (1 if stamped[group] > 0 else 0)
            size += 8 * groups[group] * columns
    return groups, stamped, size


@part
def write_variables(out: U8, here: int, groups: I64, stamped: I64, changed: I64, graph: Graph) -> int:
    """The field `variables` of a delta; gives where to write on."""
    var, keys, values, stamps = graph.var, graph.keys, graph.values, graph.stamps
    here = write_count(out, here, 0x90, np.count_nonzero(groups))
    for group in range(groups.size):
        count = groups[group]
        if count == 0:
            continue
        row = w.row_of_variables(group // 2)
        size, fixed = TOKENS[row, w.W_SIZE], group % 2
        out[here] = 0x83 + fixed + (1 if stamped[group] > 0 else 0)
        here = write_piece(out, here + 1, w.P_KIND)
        out[here] = 0xA0 + TOKENS[row, w.W_LENGTH]
        here = write_piece(out, here + 1, row)
        here = write_bin_head(out, write_piece(out, here, w.P_KEYS), 8 * count)
        for n in range(changed.size):
            if label_of_variable(changed[n], var) == group:
                here = write_word(out, here, keys[changed[n]])
        here = write_bin_head(out, write_piece(out, here, w.P_VALUES), 8 * count * size)
        for n in range(changed.size):
            if label_of_variable(changed[n], var) == group:
                for c in range(size):
                    here = write_word(out, here, np.float64(values[var[changed[n], at.V_AT] + c]).view(np.int64))
        if fixed:
            here = write_piece(out, here, w.P_FIXED)
        if stamped[group] > 0:
            here = write_bin_head(out, write_piece(out, here, w.P_STAMPS), 8 * count)
            for n in range(changed.size):
                if label_of_variable(changed[n], var) == group:
                    here = write_word(out, here, stamps[changed[n]])
    return here


@inline_kernel
def label_of_variable(variable: int, var: I64) -> int:
    """What tells groups apart: the kind, and whether it is fixed."""
    return 2 * var[variable, at.V_KIND] + (1 if var[variable, at.V_COLUMN] < 0 else 0)


@part
def write_piece(out: U8, here: int, row: int) -> int:
    """What is in a row of the table."""
    return write_bytes(out, here, LETTERS, TOKENS[row, w.W_START], TOKENS[row, w.W_LENGTH])


@part
def write_bytes(out: U8, here: int, source: bytes | U8, start: int, length: int) -> int:
    """source[start : start + length]."""
    for k in range(length):
        out[here + k] = source[start + k]
    return here + length


@part
def write_word(out: U8, here: int, bits: int) -> int:
    """A little-endian int64."""
    for k in range(8):
        out[here + k] = (bits >> np.int64(8 * k)) & 0xFF
    return here + 8


@inline_kernel
def write_big_endian(out: U8, here: int, head: int, value: int, size: int) -> int:
    """A byte, and an integer of `size` bytes."""
    out[here] = head
    for k in range(size):
        out[here + 1 + k] = (value >> (8 * (size - 1 - k))) & 0xFF
    return here + 1 + size


@part
def write_integer(out: U8, here: int, value: int) -> int:
    """An integer from 0 on, in the shortest form."""
    if value < 0x80:
        out[here] = value
        return here + 1
    if value <= 0xFF:
        return write_big_endian(out, here, 0xCC, value, 1)
    if value <= 0xFFFF:
        return write_big_endian(out, here, 0xCD, value, 2)
    if value <= 0xFFFFFFFF:
        return write_big_endian(out, here, 0xCE, value, 4)
    return write_big_endian(out, here, 0xCF, value, 8)


@inline_kernel
def write_count(out: U8, here: int, head: int, count: int) -> int:
    """The head of an array."""
    if count <= 15:
        out[here] = head + count
        return here + 1
    return write_big_endian(out, here, 0xDC, count, 2)


@part
def write_bin_head(out: U8, here: int, size: int) -> int:
    """The head of a bin of `size` bytes."""
    if size <= 0xFF:
        return write_big_endian(out, here, 0xC4, size, 1)
    if size <= 0xFFFF:
        return write_big_endian(out, here, 0xC5, size, 2)
    return write_big_endian(out, here, 0xC6, size, 4)
