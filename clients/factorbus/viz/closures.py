"""Loop closures with how badly they fit, and the colour that says so."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.viz.odometry import loops_of
from factorbus.viz.residuals import Values, chi2_of_factors

# Sky blue, yellow, vermilion of Okabe and Ito, at a misfit of 0, 1.5 and 3 and above.
_COLOURS = np.array([[86, 180, 233], [240, 228, 66], [213, 94, 0]]) / 255.0
_WORST = 3.0


@dataclass(frozen=True, slots=True)
class Closures:
    """Edges between poses that do not follow each other: keys (m, 2), misfit (m,) = √(rᵀ Ω r / dim), about 1 for a
    measurement whose information is right."""

    keys: I64
    misfit: F64


def closures_of(variables: Sequence[Variables], factors: Sequence[Factors]) -> Closures:
    """The loop closures among `factors`, fitted to `variables`; edges of a kind in their order."""
    loops = {tuple(pair) for pair in loops_of(Batch(tuple(variables), tuple(factors))).tolist()}
    values = Values(variables)
    keys, misfits = [np.empty((0, 2), np.int64)], [np.empty(0)]
    for group in factors:
        if group.kind in ("between_se2", "between_se3", "between_sim3"):
            chosen = np.fromiter((tuple(pair) in loops for pair in group.keys.tolist()), bool, len(group.keys))
            some = Factors(group.kind, group.keys[chosen], group.measured[chosen], group.information[chosen])
            keys.append(some.keys)
            misfits.append(np.sqrt(chi2_of_factors(some, values) / FACTOR_KINDS[group.kind].dim))
    return Closures(np.concatenate(keys), np.concatenate(misfits))


def colours_of(misfit: F64) -> F64:
    """Red, green, blue (m, 3), from 0 to 1: blue fits, yellow is doubtful, vermilion contradicts; NaN as 0."""
    at = np.nan_to_num(misfit, nan=0.0).clip(0, _WORST) * 2 / _WORST
    low = np.minimum(at.astype(int), 1)
    share = (at - low)[:, None]
    return (1 - share) * _COLOURS[low] + share * _COLOURS[low + 1]
