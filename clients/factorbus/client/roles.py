"""A graph apart from the variables that are no places in its map, and how those move with it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from factorbus.client.frames import moved_values
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.roles import AXES, FRAME, MOUNT, keys_of_role, mounts_of, pick_factors, pick_variables, poses_aside

_NONE = np.empty(0, np.int64)


class Roles(NamedTuple):
    """The keys of a map's mounts, other frames, and vectors along its axes (`FactorKind.roles`)."""

    mounts: I64 = _NONE
    frames: I64 = _NONE
    axes: I64 = _NONE

    def rows(self, keys: I64) -> Iterator[tuple[str, np.ndarray]]:
        """Each role that there is among keys (n,), "" of places and of all other numbers, and which have it (n,)."""
        others = np.ones(len(keys), bool)
        for role, of_role in ((MOUNT, self.mounts), (FRAME, self.frames), (AXES, self.axes)):
            chosen = np.isin(keys, of_role)
            others &= ~chosen
            if chosen.any():
                yield role, chosen
        if others.any():
            yield "", others

    def moved(self, kind: str, keys: I64, values: F64, T_a_b: F64) -> F64:
        """Values (n, size) of variables with these keys, given in b, as they are in a."""
        made = values.copy()
        for role, chosen in self.rows(keys):
            made[chosen] = moved_values(kind, values[chosen], T_a_b, role)
        return made


def roles_of(batch: Batch) -> Roles:
    """What the factors of a graph say of its variables."""
    return Roles(*(keys_of_role(batch, role) for role in (MOUNT, FRAME, AXES)))


def split_mounts(batch: Batch) -> tuple[Batch, Batch]:
    """(mounts, and what is known of them alone; all else)."""
    return _split(batch, mounts_of(batch))


def of_the_map(batch: Batch) -> tuple[Variables, ...]:
    """The variables that are in the frame of the map: all but mounts and other frames."""
    return _split(batch, poses_aside(batch))[1].variables


def _split(batch: Batch, aside: I64) -> tuple[Batch, Batch]:
    """(the variables with these keys, and the factors of them alone; all else)."""
    if not aside.size:
        return Batch(), batch
    variables, factors = ([], []), ([], [])
    for group in batch.variables:
        chosen_aside = np.isin(group.keys, aside)
        for half, chosen in ((0, chosen_aside), (1, ~chosen_aside)):
            if chosen.any():
                variables[half].append(pick_variables(group, chosen))
    for group in batch.factors:
        chosen_aside = np.asarray(np.isin(group.keys, aside).all(axis=1))
        for half, chosen in ((0, chosen_aside), (1, ~chosen_aside)):
            if chosen.any():
                factors[half].append(pick_factors(group, chosen))
    first, second = (Batch(tuple(variables[half]), tuple(factors[half])) for half in (0, 1))
    return first, second
