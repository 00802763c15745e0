"""The answer to an insert and the delta of its step, as bytes: those of `codec.encode_accepted` and `encode_delta`."""

import numpy as np

from factorbus.service.kernels import words as w
from factorbus.service.kernels.compile import F64, I64, U8, inline_kernel, kernel, part
from factorbus.solver.kernels.model import layout as at

# No message is longer than this but for its columns and its report; nor is what a group adds to its columns.
_MOST_HEAD, _MOST_GROUP = 128, 96


@kernel(
    "UniTuple(int64, 2)(int64, int64, int64, int64, Bytes(uint8, 1, 'C', readonly=True), int64[::1], int64[:,::1],"
    " int64[::1], float64[::1], int64[::1], int64[:,::1], uint8[::1], uint8[::1])"
)
def write_messages(
    sequence: int,
    epoch: int,
    revision: int,
    first_factor: int,
    report: bytes,
    changed: I64,
    var: I64,
    keys: I64,
    values: F64,
    stamps: I64,
    words: I64,
    letters: U8,
    out: U8,
) -> tuple:
    """Write the answer to the only insert of a step, and behind it the delta; gives their lengths, (0, 0): no room.

    report: encoded, in both.  changed: the variables that the delta tells of, ascending.
    """
    groups, stamped, columns = count_groups(changed, var, stamps, words)
    size = 2 * (_MOST_HEAD + len(report)) + columns
    for label in range(groups.size):
        if groups[label] > 0:
            size += _MOST_GROUP
    if size > out.size:
        return 0, 0
    here = write_integer(out, write_piece(out, 0, w.P_SEQUENCE, words, letters), sequence)
    here = write_integer(out, write_piece(out, here, w.P_EPOCH, words, letters), epoch)
    here = write_integer(out, write_piece(out, here, w.P_REVISION, words, letters), revision)
    here = write_integer(out, write_piece(out, here, w.P_FIRST_FACTOR, words, letters), first_factor)
    here = write_piece(out, here, w.P_APPLIED, words, letters)
    answer = write_bytes(out, write_piece(out, here, w.P_REPORT, words, letters), report, 0, len(report))
    here = write_integer(out, write_piece(out, answer, w.P_DELTA, words, letters), epoch)
    here = write_integer(out, write_piece(out, here, w.P_REVISION, words, letters), revision)
    here = write_integer(out, write_piece(out, here, w.P_PREVIOUS, words, letters), revision - 1)
    here = write_variables(out, write_piece(out, here, w.P_VARIABLES, words, letters), groups, stamped, changed, var,
                           keys, values, stamps, words, letters)  # fmt: skip
    here = write_bytes(out, write_piece(out, here, w.P_REPORT, words, letters), report, 0, len(report))
    return answer, here - answer


@part
def count_groups(changed: I64, var: I64, stamps: I64, words: I64) -> tuple:
    """(how many there are of each kind, those that are not fixed before those that are; how many of them have a time
    stamp; bytes of their columns)."""
    kinds = 0
    for row in range(words.shape[0]):
        if words[row, w.W_ROLE] == w.VARIABLE_KIND:
            kinds = max(kinds, words[row, w.W_CODE] + 1)
    groups, stamped, size = np.zeros(2 * kinds, np.int64), np.zeros(2 * kinds, np.int64), 0
    for n in range(changed.size):
        label = label_of(changed[n], var)
        groups[label] += 1
        stamped[label] += 1 if stamps[changed[n]] != at.NO_STAMP else 0
    for label in range(groups.size):
        if groups[label] > 0:
            columns = 1 + words[w.row_of_variables(label // 2, words), w.W_SIZE] + (1 if stamped[label] > 0 else 0)
            size += 8 * groups[label] * columns
    return groups, stamped, size


@part
def write_variables(
    out: U8, here: int, groups: I64, stamped: I64, changed: I64, var: I64, keys: I64, values: F64, stamps: I64,
    words: I64, letters: U8,
) -> int:  # fmt: skip
    """The field `variables` of a delta; gives where to write on."""
    here = write_count(out, here, 0x90, np.count_nonzero(groups))
    for label in range(groups.size):
        count = groups[label]
        if count == 0:
            continue
        row = w.row_of_variables(label // 2, words)
        size, fixed = words[row, w.W_SIZE], label % 2
        out[here] = 0x83 + fixed + (1 if stamped[label] > 0 else 0)
        here = write_piece(out, here + 1, w.P_KIND, words, letters)
        out[here] = 0xA0 + words[row, w.W_LENGTH]
        here = write_piece(out, here + 1, row, words, letters)
        here = write_bin_head(out, write_piece(out, here, w.P_KEYS, words, letters), 8 * count)
        for n in range(changed.size):
            if label_of(changed[n], var) == label:
                here = write_word(out, here, keys[changed[n]])
        here = write_bin_head(out, write_piece(out, here, w.P_VALUES, words, letters), 8 * count * size)
        for n in range(changed.size):
            if label_of(changed[n], var) == label:
                for c in range(size):
                    here = write_word(out, here, np.float64(values[var[changed[n], at.V_AT] + c]).view(np.int64))
        if fixed:
            here = write_piece(out, here, w.P_FIXED, words, letters)
        if stamped[label] > 0:
            here = write_bin_head(out, write_piece(out, here, w.P_STAMPS, words, letters), 8 * count)
            for n in range(changed.size):
                if label_of(changed[n], var) == label:
                    here = write_word(out, here, stamps[changed[n]])
    return here


@inline_kernel
def label_of(variable: int, var: I64) -> int:
    """What tells groups apart: the kind, and whether it is fixed."""
    return 2 * var[variable, at.V_KIND] + (1 if var[variable, at.V_COLUMN] < 0 else 0)


@part
def write_piece(out: U8, here: int, row: int, words: I64, letters: U8) -> int:
    """What is in a row of the table."""
    return write_bytes(out, here, letters, words[row, w.W_START], words[row, w.W_LENGTH])


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
