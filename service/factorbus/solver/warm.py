"""Compile every kernel ahead of its first use."""

import importlib
import pkgutil
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any

from factorbus.solver import kernels
from factorbus.solver.covariance import kernels as covariance_kernels
from factorbus.solver.kernels.jit.compile import compile_seconds, is_on_disk, iter_compile, only_compile

__all__ = ["iter_compile", "list_missing", "only_compile", "warm"]


def warm(progress: Callable[[str], None] | None = None, *packages: ModuleType) -> float:
    """Compile (or load from disk) all kernels in `packages`, the solver's own by default; gives the seconds spent
    compiling.

    `progress` is called with the name of each file of kernels before its turn.
    """
    before = compile_seconds()
    for package in packages or (kernels, covariance_kernels):
        for name, found in _iter_groups(package):
            if progress:
                progress(name)
            for _ in iter_compile(*found):
                pass
    return compile_seconds() - before


def list_missing(*packages: ModuleType) -> list[Any]:
    """The kernels in `packages`, the solver's own by default, that are not on disk: compiling one puts it there."""
    return [
        one
        for package in packages or (kernels, covariance_kernels)
        for _, group in _iter_groups(package)
        for one in group
        if not is_on_disk(one)
    ]


def _iter_groups(package: ModuleType = kernels) -> Iterator[tuple[str, list[Any]]]:
    """(file, its kernels with declared signatures)."""
    for entry in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(entry.name)
        found = [
            thing
            for thing in vars(module).values()
            if getattr(thing, "factorbus_signatures", ()) and thing.__module__ == module.__name__
        ]
        if found:
            yield entry.name.removeprefix(f"{package.__name__}."), found
