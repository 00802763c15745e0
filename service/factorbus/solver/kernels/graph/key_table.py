"""The variable of a key: an open-addressing hash table, `table`, which holds variable index + 1, and 0 where free.

Variables are entered in the order of their indices and removed in the reverse order, so removing is clearing the slot.
"""

from factorbus.solver.kernels.jit.compile import I64, inline_kernel, kernel


@inline_kernel
def slot_of(key: int, table: I64, keys: I64) -> int:
    """Where `key` is in the table, or the free slot where it would go."""
    k = int(key)
    h = k ^ (k >> 32)
    h = (h * 0x45D9F3B) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    h ^= h >> 16
    mask = table.size - 1
    slot = h & mask
    while table[slot] != 0 and keys[table[slot] - 1] != key:
        slot = (slot + 1) & mask
    return slot


@kernel("int64(int64, int64[::1], int64[::1])")
def find_variable(key: int, table: I64, keys: I64) -> int:
    """Index of the variable `key`, or −1."""
    return int(table[slot_of(key, table, keys)]) - 1


@kernel("void(int64, int64[::1], int64[::1])")
def enter_keys(count: int, table: I64, keys: I64) -> None:
    """Fill an empty table with the first `count` keys."""
    for v in range(count):
        table[slot_of(keys[v], table, keys)] = v + 1


@kernel("void(int64, int64, int64[::1], int64[::1])")
def remove_keys(first: int, last: int, table: I64, keys: I64) -> None:
    """Remove the variables first .. last−1, which are the last that were entered."""
    for v in range(last - 1, first - 1, -1):
        table[slot_of(keys[v], table, keys)] = 0
