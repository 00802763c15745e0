"""Arrays that kernels work on, and the table of their addresses that one argument of a kernel carries."""

from typing import Any, ClassVar

import numpy as np

from factorbus.solver.kernels.jit.array_table import WIDTH
from factorbus.solver.kernels.jit.compile import I64

_LINE = 64  # bytes of a cache line


def lines(shape: int | tuple[int, ...], kind: type[np.generic] | np.dtype[Any]) -> np.ndarray:
    """Zeros from the start of a cache line on, with a line behind them that may be read.

    A row of eight numbers is in one line then, and not in two.
    """
    size = int(np.prod(shape)) * np.dtype(kind).itemsize
    raw = np.zeros(size + 2 * _LINE, np.uint8)
    skip = -raw.ctypes.data % _LINE
    return raw[skip : skip + size].view(kind).reshape(shape)


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
