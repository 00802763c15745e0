"""A map on the bus, as those look at it who draw: what changed since they last looked, and the factors now and then.

Deltas come with every step and are small.  Factors are not published; they are asked for, all of them, when there are
new ones, and the less often the longer the answer takes.
"""

import threading
import time
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from factorbus.client import Map
from factorbus.client.stream import DeltaStream
from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Delta, Factors, Graph, Variables

# The share of the time that a service spends on answering with its factors is at most one in so many.
_SPARE = 10
_LEAST_PAUSE_S = 0.5


@dataclass(frozen=True, slots=True)
class Look:
    """One look.  variables: everything, at `revision`.  deltas: the steps since the last look, oldest first; one with
    `previous` 0 brings everything anew.  factors: those of `factors_revision`, which may be older."""

    epoch: int
    revision: int
    variables: tuple[Variables, ...]
    deltas: tuple[Delta, ...]
    factors: tuple[Factors, ...]
    factors_revision: int
    stale: bool

    def touched(self) -> I64:
        """Keys of what the last step changed; empty after none, or after everything came anew."""
        if not self.deltas or not self.deltas[-1].previous:
            return np.empty(0, np.int64)
        return np.concatenate([np.empty(0, np.int64), *(group.keys for group in self.deltas[-1].variables)])


class Lookout:
    """Follows a joined map that has a mirror.  One thread looks; close it, or use it in `with`."""

    def __init__(self, joined: Map, with_factors: bool = True) -> None:
        self._map, self._mirror = joined, joined.estimate
        self._news = threading.Event()
        self._stream = DeltaStream(self._mirror, self._news.set)
        self._graph = Graph(0, 0, Batch())
        self._asked: Future[Graph] | None = None
        self._asked_at, self._next_at = 0.0, 0.0
        self._with_factors = with_factors

    def __enter__(self) -> "Lookout":
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
        if self._with_factors:
            self._refresh(snapshot.epoch, snapshot.revision)
        variables = tuple(Variables(kind, keys, values) for kind, (keys, values) in snapshot.columns.items())
        graph = self._graph if self._graph.epoch == snapshot.epoch else Graph(snapshot.epoch, 0, Batch())
        return Look(
            snapshot.epoch,
            snapshot.revision,
            variables,
            deltas,
            graph.batch.factors,
            graph.revision,
            self._mirror.stale,
        )

    def last_look(self, timeout_s: float) -> Look:
        """A look with the factors of this revision or a later one, waiting for them.  Raises Refused, Unavailable."""
        if self._with_factors:
            self._graph = self._map.graph(timeout_s)
        return self.look()

    def close(self) -> None:
        """Look no more."""
        self._stream.close()

    def _refresh(self, epoch: int, revision: int) -> None:
        """Take the factors that came, and ask for newer ones if there are any and it is time."""
        now = time.monotonic()
        if self._asked is not None and self._asked.done():
            asked, self._asked = self._asked, None
            self._next_at = now + max(_LEAST_PAUSE_S, _SPARE * (now - self._asked_at))
            if asked.exception() is None:  # otherwise the mirror says that it is stale, and it is asked again
                self._graph = asked.result()
        behind = (self._graph.epoch, self._graph.revision) != (epoch, revision)
        if self._asked is None and behind and now >= self._next_at:
            self._asked, self._asked_at = self._map.ask.graph(None), now
            self._asked.add_done_callback(lambda _: self._news.set())
