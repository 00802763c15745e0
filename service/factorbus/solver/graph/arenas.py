"""Arrays that kernels work on, and the table of their addresses that one argument of a kernel carries."""

from typing import Any, ClassVar

import numpy as np

from factorbus.solver.kernels.jit.array_table import WIDTH
from factorbus.solver.kernels.jit.compile import I64

_LINE = 64  # bytes of a cache line
_LEAST_SLOTS = 1024
_MUCH = 4096  # rows


def lines(shape: int | tuple[int, ...], kind: type[np.generic] | np.dtype[Any]) -> np.ndarray:
    """Zeros from the start of a cache line on, with a line behind them that may be read.

    A row of eight numbers is in one line then, and not in two.
    """
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    raw = np.zeros(size + 2 * _LINE, np.uint8)
    skip = -raw.ctypes.data % _LINE
    return raw[skip : skip + size].view(kind).reshape(shape)


def with_room(array: np.ndarray, need: int) -> np.ndarray:
    """A copy with room for at least `need` rows, and more for the next ones; the new room is zero."""
    larger = lines((roomy(need, len(array)), *array.shape[1:]), array.dtype)
    larger[: len(array)] = array
    return larger


def roomy(need: int, size: int) -> int:
    """How long to make an array of `size` that is to have `need`: four times what it is, or twice if that is much.

    To find that there is no room, and begin again, takes longer than to copy a few pages.  It does not look at how wide
    rows are: arrays with a row for each of the same things, and as long, stay as long as each other.
    """
    return max(need, (4 if size < _MUCH else 2) * size)


def table_size(entries: int) -> int:
    """Slots of a hash table that is to hold `entries` and grow further: a power of two, a quarter full or less."""
    return 1 << (4 * entries - 1).bit_length()


def slots_of(variables: int) -> int:
    """Slots of a table of keys: half full or less, and of one size with as many variables, however they came."""
    return max(_LEAST_SLOTS, 1 << (2 * variables - 1).bit_length())


class Arenas:
    """What has arrays as attributes, `ARENAS` in the order of its table, and the table: `array_table`, for kernels.

    Inherited, since every assignment to one of them has to be seen: a table must not tell of an array that is gone.
    """

    ARENAS: ClassVar[tuple[str, ...]] = ()
    array_table: I64

    def __setattr__(self, name: str, value: Any) -> None:
        """Raises TypeError for an arena that no kernel can work on in place."""
        if name in self.ARENAS:
            row = _placed(name, value)
            if "array_table" not in vars(self):
                object.__setattr__(self, "array_table", np.zeros(WIDTH * len(self.ARENAS), np.int64))
            first = WIDTH * self.ARENAS.index(name)
            self.array_table[first : first + WIDTH] = row
        object.__setattr__(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in vars(self).items() if name != "array_table"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """For copies: what has other arrays needs another table."""
        for name, value in state.items():
            setattr(self, name, value)


def _placed(name: str, array: np.ndarray) -> tuple[int, ...]:
    fit = array.flags.carray and array.dtype in (np.int64, np.float64) and 1 <= array.ndim < WIDTH
    if not fit:
        raise TypeError(
            f"{name} is {array.dtype}, {array.ndim} dimensions, no array that a kernel can work on in place"
        )
    rows, columns = array.shape if array.ndim == 2 else (array.size, 1)
    return array.ctypes.data, rows, columns
