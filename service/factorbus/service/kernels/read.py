"""An insert as usual, read where it lies: where its columns are, instead of the columns.

It knows the usual forms only: short maps and arrays, known fields, each once, unsigned integers.  Whatever else it
finds it leaves to `codec.decode_insert`, which takes more, and says what is wrong with the rest.  What it accepts, that
accepts, with the same content.
"""

import numpy as np

from factorbus.service.kernels import words as w
from factorbus.service.kernels.compile import I64, U8, inline_kernel, kernel, part
from factorbus.service.kernels.digest import digest_bytes
from factorbus.service.kernels.words import look_up
from factorbus.solver.kernels.model import layout as at

# In place of where to read on: this is nothing usual.
_LOST = -1
_MAP, _ARRAY, _STR = 0x80, 0x90, 0xA0
_NIL, _FALSE, _TRUE, _BIN, _UINT = 0xC0, 0xC2, 0xC3, 0xC4, 0xCC


@kernel("UniTuple(int64, 4)(Bytes(uint8, 1, 'C', readonly=True), int64[:,::1], uint8[::1], int64[:,::1])")
def read_insert(raw: bytes, words: I64, letters: U8, groups: I64) -> tuple:
    """(sequence, epoch, settle, digest) of an insert; where its groups lie goes to `groups`.  Sequence 0: not read."""
    sequence, epoch, settle, seen, count = 0, 0, 0, 0, 0
    fields, here = read_head(raw, 0, _MAP)
    for _ in range(fields):
        row, here = read_word(raw, here, w.IN_INSERT, words, letters)
        if here < 0 or seen >> row & 1:
            return 0, 0, 0, 0
        seen |= 1 << row
        field = words[row, w.W_CODE]
        if field == w.SEQUENCE:
            sequence, here = read_integer(raw, here)
        elif field == w.EPOCH:
            epoch, here = read_integer(raw, here)
        elif field == w.SETTLE:
            settle, here = read_flag(raw, here)
        else:
            factors = 1 if field == w.FACTORS else 0
            size, here = read_head(raw, here, _ARRAY)
            for _ in range(size):
                if here >= 0 and count < groups.shape[0] - 1:
                    here = read_group(raw, here, factors, words, letters, groups[count])
                    count += 1
                else:
                    here = _LOST
        if here < 0:
            return 0, 0, 0, 0
    groups[count, at.G_KIND] = at.END
    if here != len(raw):
        return 0, 0, 0, 0
    return sequence, epoch, settle, digest_bytes(raw)


@part
def read_group(raw: bytes, here: int, factors: int, words: I64, letters: U8, group: I64) -> int:
    """Read one group of variables or factors into its row; gives where to read on."""
    kind, seen, fixed = -1, 0, 0
    keys, keys_size, numbers, numbers_size, information, information_size = -1, 0, -1, 0, -1, 0
    stamps, stamps_size = -1, 0
    fields, here = read_head(raw, here, _MAP)
    for _ in range(fields):
        row, here = read_word(raw, here, w.IN_GROUP, words, letters)
        if here < 0 or seen >> row & 1:
            return _LOST
        seen |= 1 << row
        field = words[row, w.W_CODE]
        if field == w.KIND:
            kind, here = read_word(raw, here, w.FACTOR_KIND if factors else w.VARIABLE_KIND, words, letters)
        elif field == w.KEYS:
            keys, keys_size, here = read_bin(raw, here)
        elif field == (w.MEASURED if factors else w.VALUES):
            numbers, numbers_size, here = read_bin(raw, here) if factors else read_bin_or_nil(raw, here)
        elif factors and field == w.INFORMATION:
            information, information_size, here = read_bin(raw, here)
        elif not factors and field == w.FIXED:
            fixed, here = read_flag(raw, here)
        elif not factors and field == w.STAMPS:
            stamps, stamps_size, here = read_bin_or_nil(raw, here)
        else:
            return _LOST
        if here < 0:
            return _LOST
    if here < 0 or kind < 0 or keys < 0:
        return _LOST
    arity, size, triangle = words[kind, w.W_ARITY], words[kind, w.W_SIZE], words[kind, w.W_TRIANGLE]
    count = keys_size // (8 * arity)
    if keys_size != 8 * arity * count:
        return _LOST
    if (factors or numbers >= 0) and numbers_size != 8 * count * size:
        return _LOST
    if stamps >= 0 and stamps_size != 8 * count:
        return _LOST
    if factors and (numbers < 0 or information < 0 or information_size != 8 * count * triangle):
        return _LOST
    group[at.G_KIND], group[at.G_FACTORS], group[at.G_COUNT] = words[kind, w.W_CODE], factors, count
    group[at.G_FIXED], group[at.G_ARITY], group[at.G_SIZE], group[at.G_TRIANGLE] = fixed, arity, size, triangle
    group[at.G_KEYS], group[at.G_NUMBERS], group[at.G_INFORMATION] = keys, numbers, information
    group[at.G_STAMPS] = stamps
    return here


@inline_kernel
def read_head(raw: bytes, here: int, what: int) -> tuple:
    """(how many entries, where to read on) of a short map or array."""
    if 0 <= here < len(raw):
        first = np.int64(raw[here])
        if first & 0xF0 == what:
            return first & 0x0F, here + 1
    return 0, _LOST


@inline_kernel
def read_word(raw: bytes, here: int, role: int, words: I64, letters: U8) -> tuple:
    """(row in the table, where to read on) of a short string that is one of the words of a role."""
    if 0 <= here < len(raw):
        length = np.int64(raw[here]) - _STR
        if 0 <= length <= w.LONGEST and here + 1 + length <= len(raw):
            row = look_up(raw, here + 1, length, role, words, letters)
            if row >= 0:
                return row, here + 1 + length
    return -1, _LOST


@inline_kernel
def read_flag(raw: bytes, here: int) -> tuple:
    """(0 or 1, where to read on) of a boolean."""
    if 0 <= here < len(raw):
        first = np.int64(raw[here])
        if _FALSE <= first <= _TRUE:
            return first - _FALSE, here + 1
    return 0, _LOST


@inline_kernel
def read_integer(raw: bytes, here: int) -> tuple:
    """(value, where to read on) of an unsigned integer below 2⁶³."""
    if not 0 <= here < len(raw):
        return 0, _LOST
    first = np.int64(raw[here])
    if first < 0x80:
        return first, here + 1
    if not _UINT <= first < _UINT + 4:
        return 0, _LOST
    value, after = read_big_endian(raw, here + 1, 1 << (first - _UINT))
    return (value, after) if value >= 0 else (0, _LOST)


@inline_kernel
def read_bin(raw: bytes, here: int) -> tuple:
    """(where its content starts, bytes of that, where to read on) of a bin."""
    if not 0 <= here < len(raw):
        return -1, 0, _LOST
    first = np.int64(raw[here])
    if not _BIN <= first < _BIN + 3:
        return -1, 0, _LOST
    size, start = read_big_endian(raw, here + 1, 1 << (first - _BIN))
    if start < 0 or start + size > len(raw):
        return -1, 0, _LOST
    return start, size, start + size


@inline_kernel
def read_bin_or_nil(raw: bytes, here: int) -> tuple:
    """The same; of nil, which is the same as no such field, there is no content."""
    if 0 <= here < len(raw) and np.int64(raw[here]) == _NIL:
        return -1, 0, here + 1
    return read_bin(raw, here)


@inline_kernel
def read_big_endian(raw: bytes, here: int, size: int) -> tuple:
    """(value, where to read on) of an integer of `size` bytes; above 2⁶³ − 1 it comes out negative."""
    if here + size > len(raw):
        return np.int64(0), _LOST
    value = np.int64(0)
    for k in range(size):
        value = value << np.int64(8) | np.int64(raw[here + k])
    return value, here + size
