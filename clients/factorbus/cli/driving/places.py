"""The estimate without what is no place in the map: mounts of sensors, and the map's pose in the frame of GNSS."""

from collections.abc import Iterable, Sequence

import numpy as np

from factorbus.proto.messages import Batch, Variables
from factorbus.proto.roles import pick_variables, poses_aside


def places_only(estimate: Sequence[Variables], batches: Iterable[Batch]) -> tuple[Variables, ...]:
    """The variables that are places; batches: all that went into the map, whose factors tell which are."""
    aside = np.concatenate([np.empty(0, np.int64), *map(poses_aside, batches)])
    if not aside.size:
        return tuple(estimate)
    return tuple(pick_variables(group, ~np.isin(group.keys, aside)) for group in estimate)
