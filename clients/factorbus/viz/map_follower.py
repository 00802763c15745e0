"""A map on the bus, as those look at it who draw: what changed since they last looked, and the factors now and then.

Deltas come with every step and are small.  Factors are not published; they are asked for, all of them, when there are
new ones, and the less often the longer the answer takes.  So are covariances, of some variables.
"""

import threading
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from factorbus.client import Map, Snapshot
from factorbus.client.stream import DeltaStream
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Delta, Factors, MapGraph, Variables
from factorbus.proto.problems import Problem, Unavailable
from factorbus.viz.certainty import MapCertainty
from factorbus.viz.ellipses import Spread
from factorbus.viz.rate_limit import RateLimited


@dataclass(frozen=True, slots=True)
class Look:
    """One look.  variables: everything, at `revision`.  deltas: the steps since the last look, oldest first; one with
    `previous` 0 brings everything anew.  factors: those of `factors_revision`, which may be older.  spread: where some
    of the variables may be; None: not asked for."""

    epoch: int
    revision: int
    variables: tuple[Variables, ...]
    deltas: tuple[Delta, ...]
    factors: tuple[Factors, ...]
    factors_revision: int
    stale: bool
    spread: Spread | None = None

    def touched(self) -> I64:
        """Keys of what the last step changed; empty after none, or after everything came anew."""
        if not self.deltas or not self.deltas[-1].previous:
            return np.empty(0, np.int64)
        return np.concatenate([np.empty(0, np.int64), *(group.keys for group in self.deltas[-1].variables)])


class MapFollower:
    """Follows a joined map that has a mirror.  One thread looks; close it, or use it in `with`.

    ellipses: of about how many poses, and points, to know where they may be.
    """

    def __init__(self, joined: Map, with_factors: bool = True, ellipses: int = 0) -> None:
        self._map, self._mirror = joined, joined.estimate
        self._news = threading.Event()
        self._stream = DeltaStream(self._mirror, self._news.set)
        self._graph = RateLimited(lambda: joined.ask.graph(None), MapGraph(0, 0, Batch()), self._news.set)
        self._with_factors = with_factors
        self._certainty = MapCertainty(joined, ellipses, self._news.set) if ellipses else None

    def __enter__(self) -> "MapFollower":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def wait(self, timeout_s: float) -> bool:
        """Until there is something new to see; False when time is up."""
        came = self._news.wait(timeout_s)
        self._news.clear()
        return came

    def look(self) -> Look:
        """What is to be seen now; never waits for the bus."""
        deltas = tuple(iter(self._stream.try_take, None))
        snapshot = self._mirror.snapshot()
        graph, now = self._graph.answer, (snapshot.epoch, snapshot.revision)
        if self._with_factors:
            graph = self._graph.refresh(lambda had: (had.epoch, had.revision) != now)
        variables = _groups(snapshot)
        graph = graph if graph.epoch == snapshot.epoch else MapGraph(snapshot.epoch, 0, Batch())
        spread = self._certainty.spread(*now, variables) if self._certainty else None
        return Look(
            snapshot.epoch,
            snapshot.revision,
            variables,
            deltas,
            graph.batch.factors,
            graph.revision,
            self._mirror.stale,
            spread,
        )

    def last_look(self, timeout_s: float) -> Look:
        """A look with the factors of this revision or a later one, waiting for them, and the values that go with them.

        Raises Refused, Unavailable.
        """
        if self._with_factors:
            graph = self._map.graph(timeout_s)
            self._graph.put(graph)
            with suppress(Unavailable):  # answers pass deltas by; a map that has begun anew never comes to it
                self._mirror.wait_for(graph.revision, timeout_s)
        if self._certainty:
            with suppress(Problem):  # a map that cannot say how certain it is can be looked at all the same
                self._certainty.wait(_groups(self._mirror.snapshot()), timeout_s)
        return self.look()

    def close(self) -> None:
        """Look no more."""
        self._stream.close()


def _groups(snapshot: Snapshot) -> tuple[Variables, ...]:
    return snapshot.variables()
