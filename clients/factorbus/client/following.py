"""Following a map's estimate by its deltas.  Pure: events in, what to do out; `mirror` has the threads and the bus.

    lost ──estimate──▶ live ──delta whose `previous` is our revision──▶ live
      ▲                  │
      └── gap, other epoch, owner gone

While lost, deltas are kept aside, the last values stay readable, and the estimate is asked for; when it comes, the
deltas that go on from it are applied.  So no change is ever skipped, and what is old says so.  A revision heard of
whose delta is not here is not yet a loss: the estimate is asked for too, and whichever comes first is taken.
"""

from collections import deque
from collections.abc import Mapping
from typing import Any

from factorbus.client.held_values import HeldValues
from factorbus.proto.messages import Delta, Estimate

# While lost this many deltas wait; if more come before the estimate does, the oldest go: the estimate is newer.
_KEPT_ASIDE = 256


class Following:
    """One map's estimate as far as it is known here."""

    def __init__(self) -> None:
        self.epoch = 0
        self.revision = 0
        self.live = False
        # At this revision; None: nobody has said.
        self.converged: bool | None = None
        self.converging: bool | None = None
        self.values = HeldValues()
        self._aside: deque[Delta] = deque(maxlen=_KEPT_ASIDE)

    def delta(self, delta: Delta) -> list[Delta]:
        """A delta came.  Returns what is new to the readers; afterwards `live` says whether an estimate is wanted."""
        if self.live and delta.epoch == self.epoch and delta.revision <= self.revision:
            return []
        if self.live and delta.epoch == self.epoch and delta.previous == 0 and self.revision:
            # The whole estimate: features have become points, so what was under their keys is no more.
            self.values = HeldValues(delta.variables)
            self._be_at(delta)
            return [delta]
        if self.live and delta.epoch == self.epoch and delta.previous == self.revision:
            self._apply(delta)
            return [delta]
        self.live = False
        self._aside.append(delta)
        return []

    def estimate(self, estimate: Estimate, values: HeldValues) -> list[Delta]:
        """The whole estimate came, with its values.  Returns what is new to the readers.

        The first item stands for the estimate itself: a delta from revision 0.
        """
        if estimate.epoch == self.epoch and estimate.revision < self.revision + self.live:
            return []
        aside = list(self._aside)
        self._aside.clear()
        news = [Delta(estimate.epoch, estimate.revision, 0, estimate.variables)]
        if (estimate.epoch, estimate.revision) != (self.epoch, self.revision):
            self.converged = self.converging = None
        self.epoch, self.revision, self.values, self.live = estimate.epoch, estimate.revision, values, True
        for delta in aside:
            if delta.epoch == self.epoch:
                news += self.delta(delta)
        return news

    def lost(self) -> None:
        """Nobody owns the map at the moment, or nobody answers: what we hold may be old."""
        self.live = False

    def _apply(self, delta: Delta) -> None:
        self.values.put(delta.variables)
        self._be_at(delta)

    def _be_at(self, delta: Delta) -> None:
        self.revision = delta.revision
        self.take_convergence(delta.report)

    def take_convergence(self, told: Mapping[str, Any]) -> None:
        """What a report, or the stats, say of this revision."""
        converged, converging = told.get("converged"), told.get("converging")
        self.converged = converged if isinstance(converged, bool) else None
        self.converging = converging if isinstance(converging, bool) else None
