"""Doubles in pages of their own, which grow where they are: to copy the largest arena of a map takes as long as
hundreds of steps, and for that long there are two of it.
"""

import mmap
from contextlib import suppress

import numpy as np

from factorbus.solver.kernels.jit.compile import F64

_DOUBLE, _LINE, _HUGE_PAGE, _LARGE = 8, 64, 2 << 20, 512 << 20  # bytes
_PRIVATE = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS  # pages that are shared cannot grow
_SMALL, _HUGE = getattr(mmap, "MADV_NOHUGEPAGE", None), getattr(mmap, "MADV_HUGEPAGE", None)
_NOTHING = np.empty(0)


def zeros(size: int) -> F64:
    """From the start of a cache line on, with a line behind them: tiles are read whole."""
    return _seen(mmap.mmap(-1, _bytes(size), _PRIVATE), size)


def enlarge(owner: object, name: str, size: int) -> None:
    """The attribute `name` of `owner` becomes `size` doubles, the first of them those that it had; the others are zero.

    It is copied only where the system cannot move pages, it does not come from here, or somebody else has a view of it.
    Raises MemoryError; nothing has changed then.
    """
    used = getattr(owner, name).size
    pages = _pages_of(getattr(owner, name))
    if pages is not None:
        setattr(owner, name, _NOTHING)
        try:
            pages.resize(_bytes(size))
            used = size
        except (BufferError, SystemError):
            pass  # it is copied
        except OSError as problem:
            raise MemoryError(f"no room for {size} doubles: {problem.strerror}") from problem
        finally:
            setattr(owner, name, _seen(pages, used))
    if used < size:
        larger = zeros(size)
        larger[:used] = getattr(owner, name)
        setattr(owner, name, larger)


def _bytes(size: int) -> int:
    """Of the pages for `size` doubles: whole huge ones where it has those, and Linux puts it where they can lie."""
    size = _DOUBLE * size + _LINE
    return size if size < _LARGE else -(-size // _HUGE_PAGE) * _HUGE_PAGE


def _pages_of(array: F64) -> mmap.mmap | None:
    pages = array.base.obj if isinstance(array.base, memoryview) else None
    return pages if isinstance(pages, mmap.mmap) else None


def _seen(pages: mmap.mmap, size: int) -> F64:
    """Small pages are found at their first use, one at a time; large arrays are faster in huge ones."""
    advice = _SMALL if len(pages) < _LARGE else _HUGE
    if advice is not None:
        with suppress(OSError):  # a system that has no huge ones
            pages.madvise(advice)
    return np.frombuffer(pages, np.float64, size)
