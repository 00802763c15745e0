"""A graph apart from the mounts of its sensors, which do not move with the map."""

from __future__ import annotations

import numpy as np

from factorbus.proto.messages import Batch, Variables
from factorbus.proto.mounts import mounts_of, pick_factors, pick_variables


def split_mounts(batch: Batch) -> tuple[Batch, Batch]:
    """(mounts, and what is known of them alone; all else)."""
    mounts = mounts_of(batch)
    if not mounts.size:
        return Batch(), batch
    variables, factors = ([], []), ([], [])
    for group in batch.variables:
        of_mounts = np.isin(group.keys, mounts)
        for half, chosen in ((0, of_mounts), (1, ~of_mounts)):
            if chosen.any():
                variables[half].append(pick_variables(group, chosen))
    for group in batch.factors:
        of_mounts = np.asarray(np.isin(group.keys, mounts).all(axis=1))
        for half, chosen in ((0, of_mounts), (1, ~of_mounts)):
            if chosen.any():
                factors[half].append(pick_factors(group, chosen))
    first, second = (Batch(tuple(variables[half]), tuple(factors[half])) for half in (0, 1))
    return first, second


def of_the_map(batch: Batch) -> tuple[Variables, ...]:
    """The variables that are in the frame of the map: all but mounts."""
    return split_mounts(batch)[1].variables
