"""How certain a map on the bus is of where things are: covariances of some of its variables, asked for now and then.

All of them would hide the map that they are drawn over, and cost the service more than they tell.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future

import numpy as np

from factorbus.client import Map
from factorbus.proto.arrays import F64, I64
from factorbus.proto.asking import Covariances
from factorbus.proto.messages import Variables
from factorbus.viz.ellipses import Spread, spread_of
from factorbus.viz.geometry import POSITION
from factorbus.viz.rate_limit import RateLimited

_LETTER_BITS = 56
_NOBODY = Covariances(0, 0, "diagonal", ())


def chosen(variables: Sequence[Variables], most: int) -> I64:
    """Keys of at most about `most` variables that have a place: the last pose of each robot, and
    an even selection of the poses and points."""
    found = [np.empty(0, np.int64)]
    for prefix in ("se", "point"):
        keys = np.sort(np.concatenate([found[0], *(_placed(group, prefix) for group in variables)]))
        if keys.size:
            last = np.flatnonzero(np.append(np.diff(keys >> _LETTER_BITS) != 0, True)) if prefix == "se" else []
            even = np.linspace(0, keys.size - 1, min(most, keys.size)).round().astype(int)
            found.append(keys[np.union1d(even, np.asarray(last, int))])
    return np.concatenate(found)


def blocks_of(answer: Covariances) -> Mapping[int, F64]:
    """Key → covariance of its tangent, of an answer with diagonal blocks."""
    return {key: block for g in answer.groups for key, block in zip(g.keys.tolist(), g.covariance, strict=True)}


class MapCertainty:
    """How certain `joined` is of at most about `most` poses and as many points.  For the thread that looks."""

    def __init__(self, joined: Map, most: int, notify: Callable[[], None] = lambda: None) -> None:
        self._map, self._most = joined, most
        self._variables: Sequence[Variables] = ()
        self._rate_limited = RateLimited(self._ask, _NOBODY, notify)

    def spread(self, epoch: int, revision: int, variables: Sequence[Variables]) -> Spread:
        """Around where things are in that revision, by the newest covariances there are; never waits."""
        self._variables = variables
        answer = self._rate_limited.refresh(lambda had: (had.epoch, had.revision) != (epoch, revision))
        return spread_of(variables, blocks_of(answer) if answer.epoch == epoch else {})

    def wait(self, variables: Sequence[Variables], timeout_s: float) -> None:
        """Until there are covariances of now.  Raises Refused, Unavailable."""
        self._variables = variables
        self._rate_limited.put(self._ask().result(timeout_s))

    def _ask(self) -> Future[Covariances]:
        keys = chosen(self._variables, self._most)
        return self._map.uncertainty.ask.covariance("diagonal", keys.tolist(), None, None)


def _placed(group: Variables, prefix: str) -> I64:
    mine = group.kind in POSITION and group.kind.startswith(prefix) and group.values is not None
    return group.keys if mine else np.empty(0, np.int64)
