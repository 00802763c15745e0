"""Variables of a graph that are not where poses and points are: mounts of sensors, which are in the frame of a robot,
and vectors along the axes of the map, such as velocities."""

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables


def mounts_of(batch: Batch) -> I64:
    """The keys of the mounts: the last variables of the factors whose kind has a mount."""
    known = [(FACTOR_KINDS.get(group.kind), group.keys) for group in batch.factors]
    found = [keys[:, -1] for kind, keys in known if kind is not None and kind.base]
    return np.unique(np.concatenate([np.empty(0, np.int64), *found]))


def axes_of(batch: Batch) -> I64:
    """The keys of the vectors along the map's axes, which turn with it: the velocities of inertial factors."""
    known = [(FACTOR_KINDS.get(group.kind), group.keys) for group in batch.factors]
    found = [
        keys[:, column]
        for kind, keys in known
        if kind is not None
        for column, role in enumerate(kind.roles)
        if role == "axes"
    ]
    return np.unique(np.concatenate([np.empty(0, np.int64), *found]))


def pick_variables(group: Variables, chosen: np.ndarray) -> Variables:
    """Some variables of a group; chosen (n,): which."""
    values, stamps = (None if each is None else each[chosen] for each in (group.values, group.stamps))
    return group._replace(keys=group.keys[chosen], values=values, stamps=stamps)


def pick_factors(group: Factors, chosen: np.ndarray) -> Factors:
    """Some factors of a group; chosen (n,): which."""
    scale, ids = (None if each is None else each[chosen] for each in (group.scale, group.ids))
    group = group._replace(measured=group.measured[chosen], information=group.information[chosen])
    return group._replace(keys=group.keys[chosen], scale=scale, ids=ids)
