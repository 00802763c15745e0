"""Compile every kernel of the service ahead of its first use: the solver's, those of features, those of the wire."""

from collections.abc import Callable

from factorbus import solver
from factorbus.idp import warm as warm_idp
from factorbus.service import kernels


def warm(progress: Callable[[str], None] | None = None) -> float:
    """Compile (or load from disk) all kernels; gives the seconds spent compiling.

    `progress` is called with the name of each file of kernels before its turn.
    """
    return solver.warm(progress) + warm_idp(progress) + solver.warm(progress, kernels)
