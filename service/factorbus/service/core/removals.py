"""When a map takes out poses that it has enough of, by its policy `keep`.  Pure: the core asks.

    all is kept ──an insert──▶ waits ──idle for a while, or after many steps──▶ plans ──nothing goes──▶ all is kept
                                                                                ▲   │ some go: an insert of its own
                                                                                └───┘

Inserts and questions go first each time; what is under way is all that they may have to wait for.  Where a plan or its
insert fails, none is made until something else changes the map.
Reasons and figures: docs/decisions/sessions.md.
"""

import math
from typing import Any, NamedTuple

from factorbus.proto import codec
from factorbus.proto.keep import KEEP_ALL
from factorbus.proto.own_clients import KEEPER
from factorbus.service.core.events import Effect, Publish, Verdict

KEEP_IDLE_S = 2.0  # since the last step with inserts
KEEP_STEPS = 128  # steps with inserts, after which a map that is never idle is looked at, too


class Planned(NamedTuple):
    """What a look at the map came to: poses that go next, 0 if none; what is lost with them, nats; those that are
    redundant and cannot go.  failed: it could not be told."""

    poses: int
    loss: float = 0.0
    left: int = 0
    failed: bool = False


class IdleRemovals:
    """What a map has done about its policy, and does next.  keep: as `keep_text` has it.  here: not elsewhere, as for a
    replica it is."""

    def __init__(self, keep: str = KEEP_ALL, here: bool = True) -> None:
        self.keep = keep
        self._active = here and keep != KEEP_ALL
        self._wanted = True  # something was inserted since a look that found nothing
        self._at_once = False  # the look before found something
        self._busy = False  # a look is under way, or what it asked for is not told yet
        self._busy_at, self._steps = -math.inf, 0
        self._planned = Planned(0)
        self._poses, self._loss, self._most, self._failed = 0, 0.0, 0.0, False

    def is_due(self, now: float) -> bool:
        """Whether the solver, which is free, is to look now."""
        if not self._active or not self._wanted or self._busy or self._failed:
            return False
        return self._at_once or self._steps >= KEEP_STEPS or now - self._busy_at >= KEEP_IDLE_S

    def ended(self, inserts: int, now: float) -> None:
        """The solver is done with `inserts` of clients."""
        if inserts:
            self._busy_at, self._steps = now, self._steps + 1
            self._wanted, self._failed = True, False

    def began(self, keep: bool) -> None:
        """The solver was given something; keep: to look."""
        if keep:
            self._busy, self._steps = True, 0

    def planned(self, planned: Planned) -> None:
        """What it found; the verdict on what goes comes later."""
        self._planned, self._at_once = planned, planned.poses > 0
        self._wanted, self._failed = planned.poses > 0, planned.failed
        self._busy = planned.poses > 0

    def undone(self) -> None:
        """What was not published did not happen."""
        self._busy = self._at_once = False
        self._wanted = True

    def told(self, verdict: Verdict, epoch: int) -> list[Effect]:
        """What became of the insert, if it is among those of the verdict: the event `kept`, if poses went."""
        outcomes = [outcome for outcome in verdict.outcomes if outcome.insert.client == KEEPER]
        if not outcomes:
            return []
        self._busy, planned, outcome = False, self._planned, outcomes[0]
        if not isinstance(outcome.answer, bytes):
            self._failed, self._at_once = True, False
            return []
        self._poses += planned.poses
        self._loss += planned.loss
        self._most = max(self._most, planned.loss / planned.poses if planned.poses else 0.0)
        told = {
            "event": "kept",
            "epoch": epoch,
            "revision": verdict.revision,
            "poses": planned.poses,
            "loss": planned.loss,
        }
        return [Publish("event", codec.encode_map(told))]

    def row(self) -> dict[str, Any]:
        """What the row of a map says of it: nothing where everything is kept."""
        return {} if self.keep == KEEP_ALL else {"keep": self.keep}

    def stats(self) -> dict[str, Any]:
        """What the statistics of a map say, since the service has it open."""
        if self.keep == KEEP_ALL:
            return {}
        told = {"removed_poses": self._poses, "loss": self._loss, "largest_loss": self._most}
        pending = self._active and self._wanted
        return {"kept": told | {"left": self._planned.left, "pending": pending, "failed": self._failed}}
