"""Mounts of sensors in a graph: poses on a robot, which are not in the frame of the map."""

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch


def mounts_of(batch: Batch) -> I64:
    """The keys of the mounts: the last variables of the factors whose kind has a mount."""
    known = [(FACTOR_KINDS.get(group.kind), group.keys) for group in batch.factors]
    found = [keys[:, -1] for kind, keys in known if kind is not None and kind.base]
    return np.unique(np.concatenate([np.empty(0, np.int64), *found]))
