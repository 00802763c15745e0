"""An insert that only adds, read where it lies: where its columns are, instead of the columns.

It reads what the wire's tokens say, each field once, in any order and in any form that MessagePack has for it. Whatever
else it finds (changes of what is there, fields of a later version, anything wrong) it leaves to `codec.decode_insert`,
which takes more, and says what is wrong with the rest.  What it accepts, that accepts, with the same content.
"""

import math

import numpy as np

from factorbus.service.kernels import wire_tokens as w
from factorbus.service.kernels.compile import I64, inline_kernel, kernel, part
from factorbus.service.kernels.digest import digest_bytes
from factorbus.service.kernels.wire_tokens import LONGEST, TOKENS, look_up
from factorbus.solver.kernels.graph import group_table as gt

# In place of where to read on: this is left to the codec.
_LOST = -1
# In place of a sequence number: the table has no room for the groups.
MORE_GROUPS = -1
# Entries of one map or array; decoders of requests take no more either.
_MOST_ENTRIES = 256
_NIL, _FALSE, _TRUE, _BIN, _FLOAT, _DOUBLE, _UINT, _INT, _STR = 0xC0, 0xC2, 0xC3, 0xC4, 0xCA, 0xCB, 0xCC, 0xD0, 0xD9
# Of a map and of an array: the first byte of the short form, whose lower half is the size, and that of the long one.
_MAP, _MAP_16, _ARRAY, _ARRAY_16, _SHORT_STR = 0x80, 0xDE, 0x90, 0xDC, 0xA0


@kernel(
    "Tuple((int64, int64, boolean, float64, int64, int64, int64))(Bytes(uint8, 1, 'C', readonly=True), int64[:,::1])"
)
def locate_insert(raw: bytes, groups: I64) -> tuple:
    """(sequence, epoch, settle, convert_below, digest, variables, factors) of an insert; where its groups lie goes to
    `groups` (n + 1, G_WIDTH).  Sequence 0: left to the codec; MORE_GROUPS: these are too few.

    variables, factors: how many there are.
    """
    sequence, epoch, settle, below, seen, count = 0, 0, False, 0.0, 0, 0
    sizes = (0, 0)
    fields, here = read_count(raw, 0, _MAP, _MAP_16)
    for _ in range(fields):
        row, here = read_word(raw, here, w.IN_INSERT)
        if here < 0 or seen >> row & 1:
            return 0, 0, False, 0.0, 0, 0, 0
        seen |= 1 << row
        field = TOKENS[row, w.W_CODE]
        if field == w.SEQUENCE:
            sequence, here = read_integer(raw, here)
        elif field == w.EPOCH:
            epoch, here = (0, here + 1) if is_nil(raw, here) else read_integer(raw, here)
        elif field == w.SETTLE:
            settle, here = read_flag(raw, here)
        elif field == w.CONVERT_BELOW:
            below, here = (0.0, here + 1) if is_nil(raw, here) else read_number(raw, here)
        else:
            factors = 1 if field == w.FACTORS else 0
            size, here = (0, here + 1) if is_nil(raw, here) else read_count(raw, here, _ARRAY, _ARRAY_16)
            for _ in range(size):
                if count + 1 >= len(groups):
                    return MORE_GROUPS, 0, False, 0.0, 0, 0, 0
                if here >= 0:
                    here = read_group(raw, here, factors, groups[count])
                if here >= 0:
                    more = groups[count, gt.G_COUNT]
                    sizes = (sizes[0], sizes[1] + more) if factors else (sizes[0] + more, sizes[1])
                    count += 1
        if here < 0:
            return 0, 0, False, 0.0, 0, 0, 0
    groups[count, gt.G_KIND] = gt.END
    if here != len(raw):
        return 0, 0, False, 0.0, 0, 0, 0
    return sequence, epoch, settle, below, digest_bytes(raw), sizes[0], sizes[1]


@part
def read_group(raw: bytes, here: int, factors: int, group: I64) -> int:
    """Read one group of variables or factors into its row; gives where to read on."""
    kind, loss, fixed, seen = -1, -1, False, 0
    # Of each column where it starts, and its bytes.
    at, size = np.full(w.GROUP_FIELDS, gt.NOWHERE), np.zeros(w.GROUP_FIELDS, np.int64)
    fields, here = read_count(raw, here, _MAP, _MAP_16)
    for _ in range(fields):
        row, here = read_word(raw, here, w.IN_FACTORS if factors else w.IN_VARIABLES)
        if here < 0 or seen >> row & 1:
            return _LOST
        seen |= 1 << row
        field = TOKENS[row, w.W_CODE]
        if field == w.KIND:
            kind, here = read_word(raw, here, w.FACTOR_KIND if factors else w.VARIABLE_KIND)
        elif field == w.FIXED:
            fixed, here = read_flag(raw, here)
        elif is_nil(raw, here):
            if TOKENS[row, w.W_NIL] == 0:
                return _LOST
            here += 1
        elif field == w.LOSS:
            loss, here = read_word(raw, here, w.LOSS_NAME)
        else:
            at[field], size[field], here = read_bin(raw, here)
        if here < 0:
            return _LOST
    if here < 0 or kind < 0 or at[w.KEYS] < 0:
        return _LOST
    count = size[w.KEYS] // (8 * TOKENS[kind, w.W_ARITY])
    for field in range(w.GROUP_FIELDS):
        if at[field] >= 0 and size[field] != 8 * count * numbers_of(field, kind):
            return _LOST
    if factors and (at[w.NUMBERS] < 0 or at[w.INFORMATION] < 0 or (at[w.SCALE] >= 0) != (loss >= 0)):
        return _LOST
    group[gt.G_KIND], group[gt.G_FACTORS], group[gt.G_COUNT] = TOKENS[kind, w.W_CODE], factors, count
    group[gt.G_FIXED], group[gt.G_LIMITED] = 1 if fixed else 0, 0
    group[gt.G_LOSS] = TOKENS[loss, w.W_CODE] if loss >= 0 else 0
    group[gt.G_KEYS], group[gt.G_NUMBERS], group[gt.G_STAMPS] = at[w.KEYS], at[w.NUMBERS], at[w.STAMPS]
    group[gt.G_INFORMATION], group[gt.G_SCALE] = at[w.INFORMATION], at[w.SCALE]
    group[gt.G_ENDS], group[gt.G_HEAD], group[gt.G_LENGTH] = (
        gt.NOWHERE,
        gt.NOWHERE,
        0,
    )  # families are the codec's
    return here


@inline_kernel
def numbers_of(field: int, kind: int) -> int:
    """How many numbers a column has for each row, of the kind in this row of the table."""
    if field == w.KEYS:
        return TOKENS[kind, w.W_ARITY]
    if field == w.NUMBERS:
        return TOKENS[kind, w.W_SIZE]
    return TOKENS[kind, w.W_TRIANGLE] if field == w.INFORMATION else 1


@part
def read_count(raw: bytes, here: int, short: int, long: int) -> tuple:
    """(how many entries, where to read on) of a map or an array, whose forms begin with `short` and `long`."""
    if not 0 <= here < len(raw):
        return 0, _LOST
    first = np.int64(raw[here])
    if first & 0xF0 == short:
        return first & 0x0F, here + 1
    if not long <= first <= long + 1:
        return 0, _LOST
    count, here = read_big_endian(raw, here + 1, 2 << (first - long))
    return (count, here) if 0 <= count <= _MOST_ENTRIES else (0, _LOST)


@part
def read_word(raw: bytes, here: int, role: int) -> tuple:
    """(row in the table, where to read on) of a string that is one of the tokens of a role."""
    if not 0 <= here < len(raw):
        return -1, _LOST
    first = np.int64(raw[here])
    length, here = first - _SHORT_STR, here + 1
    if _STR <= first < _STR + 3:
        length, here = read_big_endian(raw, here, 1 << (first - _STR))
    if here < 0 or not 0 <= length <= LONGEST or here + length > len(raw):
        return -1, _LOST
    row = look_up(raw, here, length, role)
    return (row, here + length) if row >= 0 else (-1, _LOST)


@inline_kernel
def is_nil(raw: bytes, here: int) -> bool:
    """Whether there is nil, which for most fields is the same as no such field."""
    return 0 <= here < len(raw) and np.int64(raw[here]) == _NIL


@inline_kernel
def read_flag(raw: bytes, here: int) -> tuple:
    """(value, where to read on) of a boolean."""
    if 0 <= here < len(raw):
        first = np.int64(raw[here])
        if _FALSE <= first <= _TRUE:
            return first == _TRUE, here + 1
    return False, _LOST


@part
def read_integer(raw: bytes, here: int) -> tuple:
    """(value, where to read on) of an integer from 0 to 2⁶³ − 1."""
    if not 0 <= here < len(raw):
        return 0, _LOST
    first = np.int64(raw[here])
    if first < 0x80:
        return first, here + 1
    signed = _INT <= first < _INT + 4
    if not signed and not _UINT <= first < _UINT + 4:
        return 0, _LOST
    size = 1 << (first - (_INT if signed else _UINT))
    value, after = read_big_endian(raw, here + 1, size)
    if value < 0 or (signed and value >> (8 * size - 1) != 0):
        return 0, _LOST
    return value, after


@part
def read_number(raw: bytes, here: int) -> tuple:
    """(value, where to read on) of a number from 0 on that is finite."""
    if not 0 <= here < len(raw):
        return 0.0, _LOST
    first = np.int64(raw[here])
    if first == _DOUBLE:
        bits, after = read_big_endian(raw, here + 1, 8)
        value = np.int64(bits).view(np.float64)
    elif first == _FLOAT:
        bits, after = read_big_endian(raw, here + 1, 4)
        value = np.float64(np.int32(bits).view(np.float32)) if bits >> 31 == 0 else -1.0
    else:
        whole, after = read_integer(raw, here)
        value = np.float64(whole)
    return (value, after) if value >= 0.0 and math.isfinite(value) else (0.0, _LOST)


@part
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
def read_big_endian(raw: bytes, here: int, size: int) -> tuple:
    """(value, where to read on) of an integer of `size` bytes; above 2⁶³ − 1 it comes out negative."""
    if here + size > len(raw):
        return np.int64(0), _LOST
    value = np.int64(0)
    for k in range(size):
        value = value << np.int64(8) | np.int64(raw[here + k])
    return value, here + size
