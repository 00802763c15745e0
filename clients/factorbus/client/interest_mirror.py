"""A live copy of the part of a map's estimate that somebody is interested in."""

import time
from contextlib import ExitStack
from typing import Any

from factorbus.client.arguments import checked_seconds
from factorbus.client.interest_following import InterestFollowing
from factorbus.client.link import Link
from factorbus.client.mirror import PROBE_S, Mirror
from factorbus.client.replies import AnswerReply, Failure, Reply, TimedOut
from factorbus.proto import keys
from factorbus.proto.codec import decode_problem
from factorbus.proto.interest import Interest
from factorbus.proto.interest_codec import (
    AskInterest,
    decode_interest_answer,
    decode_interest_delta,
    encode_ask_interest,
)
from factorbus.proto.problems import Problem, Refused

_POLL_S = 0.1  # a reader that waits for a revision has it asked for this often, or once a period
_RENEWALS = 3  # in a lease
_PASSING = ("busy", "shutting_down", "journal_failed", "unknown_map")


class InterestMirror(Mirror):
    """As `Mirror`, of the variables in one interest alone.

    It is behind the map by up to a period, and by what `waiting` says where the bytes per second do not suffice.  A
    subclass, and no part that is handed in: threads, waiting and readers are the same, only what is said on the bus
    differs.
    """

    def __init__(self, link: Link, map_name: str, timeout_s: float, interest: Interest) -> None:
        super().__init__(link, map_name, timeout_s)
        self.interest = interest
        self._held_of = f"the part of map {map_name!r} that its interest mirrors here,"
        self._following: InterestFollowing = InterestFollowing()
        self._channel = ExitStack()
        self._renew_at = 0.0
        self._wanted = 0  # a revision that a reader waits for
        self._refused: Problem | None = None

    @property
    def waiting(self) -> int:
        """Variables of the interest that the service has yet to send: those here are older than `revision`."""
        return self._following.waiting

    @property
    def stale(self) -> bool:
        """A message is missing, or nobody answers: what is here may be older than a period."""
        return not self._following.live

    def start(self, stack: ExitStack) -> None:
        """Ask, subscribe, and return when the first values are here.  Raises Refused, Unavailable."""
        stack.callback(self._channel.close)
        stack.callback(self._stop)
        self._thread.start()
        self._inbox.put(("ask", None))
        self._try_wait(lambda: self._following.live or self._refused is not None, self._timeout_s)
        if self._refused is not None:
            raise self._refused
        self.wait_for(0)

    def wait_for(self, revision: int, timeout_s: float | None = None) -> None:
        """As `Mirror.wait_for`; the service is asked for its revision meanwhile: what does not matter is not sent."""
        if isinstance(revision, int):
            self._wanted = max(self._wanted, revision)
        super().wait_for(revision, timeout_s)

    def wait_converged(self, timeout_s: float | None = None) -> None:
        """As `Mirror.wait_converged`."""
        timeout_s = checked_seconds("timeout_s", timeout_s, self._timeout_s)
        end = time.monotonic() + timeout_s
        while not (self._is_at_rest or self._closing) and (left := end - time.monotonic()) > 0:
            self._inbox.put(("renew", None))
            self._try_wait(lambda: self._is_at_rest, min(self._poll_s, left))
        super().wait_converged(max(end - time.monotonic(), 0.0))

    def catch_up(self, timeout_s: float) -> None:
        """What was inserted is here within a period, if it is in the interest: nobody waits for that."""

    @property
    def _poll_s(self) -> float:
        return max(_POLL_S, self.interest.period_ms * 1e-3)

    def _patience(self) -> float:
        if not self._following.live:
            return super()._patience()
        renewal_s = min(max(self._renew_at - time.monotonic(), 0.0), PROBE_S)
        return min(self._poll_s, renewal_s) if self._wanted > self.revision else renewal_s

    def _handle(self, word: str, content: Any) -> None:
        if word == "owner":
            self._renew_at = 0.0
        if word != "probe":
            super()._handle(word, content)
        asked = word == "renew" or (word == "probe" and self._wanted > self.revision)
        if self._following.live and (asked or time.monotonic() >= self._renew_at):
            self._probe()

    def _apply_delta(self, content: bytes) -> None:
        message = decode_interest_delta(content)
        with self._lock:
            news = self._following.message(message)
            self._confirm()
        self._callbacks.tell(news)

    def _adopt(self, data: bytes) -> None:
        answer = decode_interest_answer(data)
        following = self._following
        if answer.channel != following.channel:
            self._channel.close()
            key = keys.channel_key(self._map, answer.channel)
            self._channel.enter_context(self._link.listening(key, lambda data: self._hear("delta", data)))
            following.channel, self._ask_at = answer.channel, 0.0
            return
        with self._lock:
            news = following.answer(answer)
            self._renew_at = time.monotonic() + answer.lease_s / _RENEWALS
            self._refused = None
            self._confirm()
        self._callbacks.tell(news)

    def _take_estimate(self, reply: Reply) -> None:
        super()._take_estimate(reply)
        if isinstance(reply, Failure) and (refused := _refusal(reply)) is not None:
            with self._lock:
                self._refused = refused
                self._changed.notify_all()

    def _probe(self) -> None:
        if not self._probing:
            self._probing = True
            self._renew_at = time.monotonic() + PROBE_S  # if no answer comes
            self._query("interest", self._question(), "probed")

    def _take_probe(self, reply: Reply) -> None:
        with self._lock:
            self._probing = False
            self._changed.notify_all()
        if isinstance(reply, AnswerReply):
            self._adopt(reply.payload)
        elif not isinstance(reply, TimedOut | Failure):
            self._lose()

    def _ask(self) -> None:
        if not self._asking and time.monotonic() >= self._ask_at and not self._closing:
            self._asking = True
            self._query("interest", self._question(), "estimate")

    def _question(self) -> bytes:
        following = self._following
        ask = AskInterest(self.interest, bool(following.channel), following.stream, following.number)
        return encode_ask_interest(ask)


def _refusal(reply: Failure) -> Refused | None:
    """Why there is none; None: that will pass."""
    refused = decode_problem(reply.payload)
    return None if refused.code in _PASSING else refused
