"""Alive and ready, and meaning it.

Alive: every thread that maps depend on has come to what it was handed within `stuck_s`.  A beat is handed through the
queue of the thread itself, behind all its other work, and noted when the thread comes to it; a timer that only proves
that time passes proves nothing.  A solver that does not come out of a step is silent, however busy it is.

Ready: alive, with everything declared that was configured, not stopping, and able to take inserts into every map: not
while a journal cannot be written.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Beat = Callable[[Callable[[], None]], None]


class Pulse:
    """The heartbeat of one thread.  hand: puts a call into its queue."""

    def __init__(self, hand: Beat) -> None:
        self._hand = hand
        self._since: float | None = None  # when the beat that is under way was handed in

    def silent_s(self, now: float) -> float:
        """For how long the thread has not come to its last beat; with none under way another one goes out."""
        since = self._since
        if since is not None:
            return now - since
        self._since = now
        self._hand(self._came)
        return 0.0

    def _came(self) -> None:
        self._since = None


@dataclass(frozen=True, slots=True)
class Signs:
    """What was seen at `at` (time.monotonic): seconds that each thread was silent; why a map takes nothing in."""

    at: float
    silent_s: Mapping[str, float] = field(default_factory=dict)
    closed: Mapping[str, str] = field(default_factory=dict)


class Health:
    """What the service last saw of itself.  Any thread may ask; the one that looks is watched as well."""

    def __init__(self, stuck_s: float) -> None:
        self.stuck_s = stuck_s
        self.open = False  # everything that was configured is there, and the service is not stopping
        self._signs = Signs(time.monotonic())

    def seen(self, signs: Signs) -> None:
        """Another look."""
        self._signs = signs

    def silent_s(self) -> dict[str, float]:
        """Every thread's silence up to now, with that of the thread that looks."""
        signs = self._signs
        since_s = time.monotonic() - signs.at
        silent = {name: seconds + since_s if seconds else 0.0 for name, seconds in signs.silent_s.items()}
        return silent | {"watch": since_s}

    def stuck(self) -> list[str]:
        """Who has been silent for too long."""
        return [name for name, seconds in self.silent_s().items() if seconds > self.stuck_s]

    def alive(self) -> bool:
        """Nobody is stuck."""
        return not self.stuck()

    def missing(self) -> list[str]:
        """What keeps it from being ready."""
        closed = [f"map {name} takes nothing: {why}" for name, why in self._signs.closed.items()]
        stuck = [f"stuck: {', '.join(names)}"] if (names := self.stuck()) else []
        return [*stuck, *closed, *([] if self.open else ["not open"])]

    def ready(self) -> bool:
        """Alive and open, for every map."""
        return not self.missing()
