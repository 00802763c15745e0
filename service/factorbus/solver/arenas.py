"""Arrays that kernels work on, and the table of their addresses that one argument of a kernel carries."""

from typing import Any, ClassVar

import numpy as np

from factorbus.solver.kernels._jit import I64
from factorbus.solver.kernels.places import WIDTH


class Arenas:
    """What has arrays as attributes, `ARENAS` in the order of its table.

    Inherited, since every assignment to one of them has to be seen: a table must not tell of an array that is gone.
    """

    ARENAS: ClassVar[tuple[str, ...]] = ()
    _places: I64 | None = None

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)
        if name in self.ARENAS:
            object.__setattr__(self, "_places", None)

    def __getstate__(self) -> dict[str, Any]:
        """For copies: what has other arrays needs another table."""
        return {name: value for name, value in vars(self).items() if name != "_places"}

    def places(self) -> I64:
        """The table, as `kernels.places` reads it; it is of use until an array is assigned.  Raises TypeError."""
        if self._places is None:
            self._places = np.array([_placed(name, getattr(self, name)) for name in self.ARENAS], np.int64).ravel()
        return self._places


def _placed(name: str, array: np.ndarray) -> tuple[int, ...]:
    fit = array.flags.carray and array.dtype in (np.int64, np.float64) and 1 <= array.ndim < WIDTH
    if not fit:
        raise TypeError(
            f"{name} is {array.dtype}, {array.ndim} dimensions, no array that a kernel can work on in place"
        )
    rows, columns = array.shape if array.ndim == 2 else (array.size, 1)
    return array.ctypes.data, rows, columns
