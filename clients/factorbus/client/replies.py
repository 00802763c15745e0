"""What can come of asking somebody on the bus, and what to make of it.  Pure.

Silence (no reply at all) has four causes that look the same: nobody owns the key, access control said no, the
message was over a limit of the bus, or the service died.  So it is asked again, with the same sequence number, and
in the end all that may be said is `why_silent`.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from factorbus.proto import keys
from factorbus.proto.codec import decode_problem
from factorbus.proto.problems import Problem, Refused

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 1.0
_DEFAULT_BUSY_S = 0.05
NOBODY = "nobody replies"
_LISTS = (keys.admin_key("maps"), keys.admin_key("stats"))
# These do not use up an insert's number, and say when to come back.
_WAIT = frozenset({"busy", "journal_failed"})


@dataclass(frozen=True, slots=True)
class AnswerReply:
    """The answer's bytes."""

    payload: bytes


@dataclass(frozen=True, slots=True)
class Failure:
    """A problem's bytes."""

    payload: bytes


@dataclass(frozen=True, slots=True)
class Silence:
    """Nobody replied."""


@dataclass(frozen=True, slots=True)
class TimedOut:
    """Somebody has the question and has not replied in time."""


Reply: TypeAlias = AnswerReply | Failure | Silence | TimedOut


@dataclass(frozen=True, slots=True)
class Again:
    """Ask again after `pause_s`."""

    pause_s: float
    because: str


def interpret_reply(
    reply: Reply, attempt: int, passing: Callable[[Refused], bool] | None = None
) -> bytes | Problem | Again:
    """What `reply` to the `attempt`-th try (from 1) means: the answer, a final problem, or another try.

    passing: which refusals will not last, besides busy and shutting_down.
    """
    match reply:
        case AnswerReply(payload):
            return payload
        case Silence():
            return Again(pause(attempt), NOBODY)
        case TimedOut():
            return Again(0.0, "the service has the message and has not answered yet")
        case Failure(payload):
            return _judge_failure(payload, attempt, passing)


def why_silent(key: str) -> str:
    """What to look at where nobody replies on `key`: who keeps it, and whether this client is one that may use it."""
    if key == keys.admin_key("create"):
        do = "create maps? One that may not joins a map that is there, in Python with create=False"
    elif key.startswith(keys.admin_key("")) and key not in _LISTS:
        do = "do that, which is an operator's?"
    else:
        do = "insert under this name?" if "/in/" in key else "ask?"
    return f"is it running, and may this client {do} (access control drops what it denies without a word)"


def pause(attempt: int) -> float:
    """Seconds to wait after the `attempt`-th silence: 0.1, 0.2, 0.4, 0.8, 1, 1, ..."""
    return min(_FIRST_PAUSE_S * 2 ** min(attempt - 1, 10), _LONGEST_PAUSE_S)


def _judge_failure(payload: bytes, attempt: int, passing: Callable[[Refused], bool] | None) -> Problem | Again:
    try:
        refused = decode_problem(payload)
    except Problem as unreadable:
        return unreadable
    if refused.code in _WAIT:
        wanted = refused.detail.get("retry_after_s")
        pause_s = float(wanted) if isinstance(wanted, int | float) and 0 <= wanted <= 60 else _DEFAULT_BUSY_S
        return Again(pause_s, refused.message)
    if refused.code == "shutting_down" or (passing is not None and passing(refused)):
        return Again(pause(attempt), refused.message)
    return refused
