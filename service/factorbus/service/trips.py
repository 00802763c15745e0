"""What the way to each worker takes: measured when it joins, with jobs too small to matter.  For the desk.

One that does not answer is asked again and again until it does.
"""

import logging
import secrets
import time
from collections.abc import Callable
from typing import Any

from factorbus.proto.features import Shard, answer_size
from factorbus.proto.features_codec import encode_ask, encode_shard
from factorbus.proto.messages import Job, JobDone
from factorbus.service.jobs import SendJob
from factorbus.service.lane import Lane
from factorbus.service.rates import example
from factorbus.service.sharding import Trip

log = logging.getLogger(__name__)

_SMALL, _LARGE = 1, 96  # features asked for
_ALL = (_SMALL,) * 5 + (_LARGE,) * 5
_DEADLINE_S = 2.0


class Trips:
    """The ways to the workers of one service."""

    def __init__(self, desk: Lane, send: SendJob, heard: Callable[[str], None]) -> None:
        self._desk, self._send, self._heard = desk, send, heard
        self._here: set[str] = set()
        self._asked: set[str] = set()  # of these, those that have not answered yet
        self._known: dict[str, Trip] = {}
        self._payloads = {n: _payload(n) for n in (_SMALL, _LARGE)}

    @property
    def known(self) -> list[Trip]:
        """Of the workers that are here and have been measured."""
        return list(self._known.values())

    def row(self, worker: str) -> dict[str, float]:
        """What is known of the way to `worker`: `trip_ms`, and `byte_ns` for a byte that comes back."""
        found = self._known.get(worker)
        return {} if found is None else {"trip_ms": found.fixed_s * 1e3, "byte_ns": found.byte_s * 1e9}

    def joined(self, worker: str) -> None:
        """Measure the way to a worker that is new here."""
        self._here.add(worker)
        self._known.pop(worker, None)
        self._ask(worker, _ALL, {})

    def left(self, worker: str) -> None:
        """Forget it."""
        self._here.discard(worker)
        self._known.pop(worker, None)

    def look_for(self, suspects: list[str]) -> None:
        """Time went by: ask again whoever could not be measured, and ask suspects for a sign."""
        for worker in self._here - self._asked:
            if worker not in self._known:
                self._ask(worker, _ALL, {})
            elif worker in suspects:
                self._ask(worker, (_SMALL,), {})

    def _ask(self, worker: str, sizes: tuple[int, ...], took: dict[int, float]) -> None:
        """Send the first of `sizes`, and when it is answered the others, one after the other."""
        self._asked.add(worker)
        sent = time.perf_counter()

        def done(result: Any) -> None:
            way = time.perf_counter() - sent - (result.seconds if isinstance(result, JobDone) else 0.0)
            self._desk.hand(self._came, worker, sizes, took, result, way)

        job = Job(f"probe-{secrets.token_hex(4)}", "idp", self._payloads[sizes[0]])
        self._send(worker, job, _DEADLINE_S, done)

    def _came(self, worker: str, sizes: tuple[int, ...], took: dict[int, float], result: Any, way: float) -> None:
        self._asked.discard(worker)
        if not isinstance(result, JobDone) or worker not in self._here:
            log.debug("no sign of worker %s: %s", worker, result)
            return
        self._heard(worker)
        took[sizes[0]] = min(took.get(sizes[0], way), way)
        if len(sizes) > 1:
            self._ask(worker, sizes[1:], took)
        elif _LARGE in took:
            byte_s = max(0.0, took[_LARGE] - took[_SMALL]) / answer_size(example("half", _LARGE))
            self._known[worker] = Trip(took[_SMALL], byte_s)
            log.info("the way to worker %s takes %.2f ms and %.2f ns a byte", worker, took[_SMALL] * 1e3, byte_s * 1e9)


def _payload(n: int) -> bytes:
    return encode_shard(Shard(encode_ask(example("half", n)), 0, n))
