"""Mounts of sensors in a graph: poses on a robot, which are not in the frame of the map."""

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Factors, Variables


def mounts_of(batch: Batch) -> I64:
    """The keys of the mounts: of the variables of factors that are on a robot, as their kind says."""
    known = [(FACTOR_KINDS.get(group.kind), group.keys) for group in batch.factors]
    found = [keys[:, n] for kind, keys in known if kind is not None for n in kind.on_robot]
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
