"""Compile every kernel ahead of its first use."""

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from typing import Any

from factorbus.solver import kernels
from factorbus.solver.kernels._jit import compiled_seconds, iter_compile


def warm(progress: Callable[[str], None] | None = None) -> float:
    """Compile (or load from disk) all kernels; gives the seconds spent compiling.

    `progress` is called with the name of each file of kernels before its turn.
    """
    before = compiled_seconds()
    for name, found in _iter_groups():
        if progress:
            progress(name)
        for _ in iter_compile(*found):
            pass
    return compiled_seconds() - before


def _iter_groups() -> Iterator[tuple[str, list[Any]]]:
    """(file, its kernels with declared signatures)."""
    for entry in pkgutil.iter_modules(kernels.__path__):
        module = importlib.import_module(f"{kernels.__name__}.{entry.name}")
        found = [
            thing
            for thing in vars(module).values()
            if getattr(thing, "factorbus_signatures", ()) and thing.__module__ == module.__name__
        ]
        if found:
            yield entry.name, found
