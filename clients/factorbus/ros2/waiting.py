"""Messages whose time odometry has not come to yet.  No bus and no clock."""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from factorbus.client.draft import Draft
from factorbus.ros2.problems import BadRosMessage
from factorbus.wording import counted

_MOST = 256
_STALE_NS = 10**9  # what is later than a clock that was set back by that is of the former clock

# What uses a message once odometry is there, of (draft, its stamp, its topic, itself).
UseMessage = Callable[[Draft, int, str, Any], None]


class WaitingMessage(NamedTuple):
    """One, and what uses it."""

    stamp_ns: int
    topic: str
    message: Any
    use: UseMessage


class WaitingMessages:
    """In the order in which they came, the last of them."""

    def __init__(self) -> None:
        self._waiting: deque[WaitingMessage] = deque()

    def clear(self) -> None:
        """None waits."""
        self._waiting.clear()

    def add(self, made: WaitingMessage, last_ns: int) -> BadRosMessage | None:
        """One more; what is left out for it where too many wait.  last_ns: of the last odometry, 0 before the first."""
        self._waiting.append(made)
        if len(self._waiting) <= _MOST:
            return None
        late = self._waiting.popleft()
        after = f", {1e-9 * (late.stamp_ns - last_ns):.4g} s after the last odometry" if last_ns else ""
        wanted = f"odometry of that time before {_MOST} further messages wait: are its stamps of the same clock?"
        return BadRosMessage(late.topic, f"a stamp of {late.stamp_ns} ns{after}", wanted)

    def due(self, stamp_ns: int) -> list[WaitingMessage]:
        """Those that odometry of a time has come to; they wait no more."""
        due = [each for each in self._waiting if each.stamp_ns <= stamp_ns]
        self._waiting = deque(each for each in self._waiting if each.stamp_ns > stamp_ns)
        return due

    def set_clock_back(self, stamp_ns: int) -> Iterator[BadRosMessage]:
        """What waits for a time that the former clock had is not used."""
        last_ns = stamp_ns + _STALE_NS
        stale = [each for each in self._waiting if each.stamp_ns > last_ns]
        self._waiting = deque(each for each in self._waiting if each.stamp_ns <= last_ns)
        wanted = f"one by the clock as it was set back to, {stamp_ns} ns"
        return (BadRosMessage(each.topic, f"a stamp of {each.stamp_ns} ns", wanted) for each in stale)

    def open_ends(self, last_ns: int) -> Iterator[tuple[str, str]]:
        """(topic, what still waits), for people, where a recording ends.  last_ns: of the last odometry."""
        first = {each.topic: each.stamp_ns for each in reversed(self._waiting)}
        for topic, count in Counter(each.topic for each in self._waiting).items():
            after = (
                f"from {1e-9 * (first[topic] - last_ns):.4g} s after the last odometry on"
                if last_ns
                else "without any odometry"
            )
            yield topic, f"{counted(count, 'message')} left out at the end, {after}"
