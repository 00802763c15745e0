"""Compile every kernel of this package ahead of its first use."""

from collections.abc import Callable

from factorbus import solver
from factorbus.idp import kernels


def warm_idp(progress: Callable[[str], None] | None = None) -> float:
    """Compile (or load from disk) all kernels; gives the seconds spent compiling.

    `progress` is called with the name of each file of kernels before its turn.
    """
    return solver.warm(progress, kernels)
