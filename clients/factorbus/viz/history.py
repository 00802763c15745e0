"""How a drive went, for the panels below a map."""

from dataclasses import dataclass, field

import numpy as np

from factorbus.proto.arrays import F64


def _none() -> F64:
    return np.empty(0)


@dataclass(frozen=True, slots=True)
class DriveHistory:
    """Per step of a drive: chi2 (n,), step_ms (n,), work (n, 3); each may be empty.

    work: variables in the map, eliminated, relinearized.
    optimum (m, 2): steps and the χ² of the batch optimum at them.
    not_converged (m, 2): the same where the search for it ended before it had converged.
    """

    chi2: F64 = field(default_factory=_none)
    step_ms: F64 = field(default_factory=_none)
    optimum: F64 = field(default_factory=lambda: np.empty((0, 2)))
    work: F64 = field(default_factory=lambda: np.empty((0, 3)))
    not_converged: F64 = field(default_factory=lambda: np.empty((0, 2)))
