"""Variables that are no places in the map: mounts of sensors, poses of the map in other frames, vectors along its axes.

The factors tell: `FactorKind.each_role` has what each of their variables is.
"""

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables

MOUNT, FRAME, AXES = "mount", "frame", "axes"


def mounts_of(batch: Batch) -> I64:
    """The keys of the mounts: poses on a robot."""
    return keys_of_role(batch, MOUNT)


def poses_aside(batch: Batch) -> I64:
    """The keys of the poses that are no places in the map: mounts, and the map's poses in other frames."""
    return keys_of_role(batch, MOUNT, FRAME)


def keys_in_no_frame(graph: Batch) -> I64:
    """Mounts and plain numbers, which are the same in every frame, so that two parts of a map may have them."""
    vectors = [group.keys for group in graph.variables if VARIABLE_KINDS[group.kind].is_vector]
    return np.setdiff1d(np.concatenate([mounts_of(graph), *vectors]), keys_of_role(graph, AXES))


def keys_of_role(batch: Batch, *roles: str) -> I64:
    """The keys of the variables that a factor of `batch` has in one of these roles, ascending."""
    found = [np.empty(0, np.int64)]
    for group in batch.factors:
        kind = FACTOR_KINDS.get(group.kind)
        if kind is not None:
            found += [group.keys[:, n] for n, role in enumerate(kind.each_role) if role in roles]
    return np.unique(np.concatenate(found))


def pick_variables(group: Variables, chosen: np.ndarray) -> Variables:
    """Some variables of a group; chosen (n,): which."""
    values, stamps = (None if each is None else each[chosen] for each in (group.values, group.stamps))
    return group._replace(keys=group.keys[chosen], values=values, stamps=stamps)


def pick_factors(group: Factors, chosen: np.ndarray) -> Factors:
    """Some factors of a group; chosen (n,): which."""
    scale, ids = (None if each is None else each[chosen] for each in (group.scale, group.ids))
    group = group._replace(measured=group.measured[chosen], information=group.information[chosen])
    return group._replace(keys=group.keys[chosen], scale=scale, ids=ids)
