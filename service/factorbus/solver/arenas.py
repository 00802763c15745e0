"""Arrays that kernels work on, and the table of their addresses that one argument of a kernel carries."""

from typing import Any, ClassVar

import numpy as np

from factorbus.solver.kernels._jit import I64
from factorbus.solver.kernels.places import WIDTH

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
    """What has arrays as attributes, `ARENAS` in the order of its table.

    Inherited, since every assignment to one of them has to be seen: a table must not tell of an array that is gone.
    """

    ARENAS: ClassVar[tuple[str, ...]] = ()
    _places: I64 | None = None
    _stale: tuple[str, ...] = ()  # assigned since the table was brought up to date

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)
        if name in self.ARENAS:
            object.__setattr__(self, "_stale", (*self._stale, name))

    def __getstate__(self) -> dict[str, Any]:
        """For copies: what has other arrays needs another table."""
        return {name: value for name, value in vars(self).items() if name not in ("_places", "_stale")}

    def places(self) -> I64:
        """The table, as `kernels.places` reads it; it is of use until an array is assigned.  Raises TypeError."""
        table = self._places
        return self._brought_up() if table is None or self._stale else table

    def _brought_up(self) -> I64:
        table, names = self._places, self._stale
        if table is None:
            table, names = np.empty(WIDTH * len(self.ARENAS), np.int64), self.ARENAS
        for name in names:  # those that changed, and no others: a row takes 3 µs, and maps grow while they are small
            first = WIDTH * self.ARENAS.index(name)
            table[first : first + WIDTH] = _placed(name, getattr(self, name))
        self._places, self._stale = table, ()
        return table


def _placed(name: str, array: np.ndarray) -> tuple[int, ...]:
    fit = array.flags.carray and array.dtype in (np.int64, np.float64) and 1 <= array.ndim < WIDTH
    if not fit:
        raise TypeError(
            f"{name} is {array.dtype}, {array.ndim} dimensions, no array that a kernel can work on in place"
        )
    rows, columns = array.shape if array.ndim == 2 else (array.size, 1)
    return array.ctypes.data, rows, columns
