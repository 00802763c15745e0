"""What the way to each worker takes: measured when it joins, with jobs too small to matter.  For the control thread.

One that does not answer is asked again and again until it does.  One that does no jobs of kind `idp` says so once, and
has no way to measure; one that answers wrongly is distrusted, as with any job.
"""

import logging
import secrets
import time
from typing import Any

from factorbus.proto.features import Shard, answer_size
from factorbus.proto.features_codec import encode_ask, encode_shard
from factorbus.proto.messages import Job, JobDone
from factorbus.proto.problems import UnknownKind
from factorbus.service.jobs.job_check import WrongAnswer, checked_result
from factorbus.service.jobs.rates import example
from factorbus.service.jobs.running import Jobs, SendJob
from factorbus.service.jobs.sharding import RoundTrip
from factorbus.service.maps.serial_executor import SerialExecutor

log = logging.getLogger(__name__)

_SMALL, _LARGE = 1, 96  # features asked for
_ALL = (_SMALL,) * 5 + (_LARGE,) * 5
_DEADLINE_S = 2.0


class WorkerLatency:
    """The ways to the workers of one service."""

    def __init__(self, control: SerialExecutor, send: SendJob, jobs: Jobs) -> None:
        self._control, self._send, self._jobs = control, send, jobs
        self._here: set[str] = set()
        self._other: set[str] = set()  # of these, those that do other kinds of jobs
        self._asked: set[str] = set()  # of these, those that have not answered yet
        self._known: dict[str, RoundTrip] = {}
        self._payloads = {n: _payload(n) for n in (_SMALL, _LARGE)}

    @property
    def known(self) -> list[RoundTrip]:
        """Of the workers that are here and have been measured."""
        return list(self._known.values())

    def row(self, worker: str) -> dict[str, float]:
        """What is known of the way to `worker`: `latency_ms`, and `byte_ns` for a byte that comes back."""
        found = self._known.get(worker)
        return {} if found is None else {"latency_ms": found.fixed_s * 1e3, "byte_ns": found.byte_s * 1e9}

    def joined(self, worker: str) -> None:
        """Measure the way to a worker that is new here."""
        self._here.add(worker)
        self._other.discard(worker)
        self._known.pop(worker, None)
        self._ask(worker, _ALL, {})

    def left(self, worker: str) -> None:
        """Forget it."""
        self._here.discard(worker)
        self._other.discard(worker)
        self._known.pop(worker, None)

    def look_for(self, suspects: list[str], distrusted: list[str]) -> None:
        """Time went by: ask again those that could not be measured, and ask suspects for a sign."""
        for worker in self._here - self._asked - set(distrusted):
            if worker in suspects:
                self._ask(worker, (_SMALL,), {})
            elif worker not in self._known and worker not in self._other:
                self._ask(worker, _ALL, {})

    def _ask(self, worker: str, sizes: tuple[int, ...], took: dict[int, float]) -> None:
        """Send the first of `sizes`, and when it is answered the others, one after the other."""
        self._asked.add(worker)
        sent = time.perf_counter()

        def done(result: Any) -> None:
            there_s = result.seconds if isinstance(result, JobDone) else 0.0
            way = max(0.0, time.perf_counter() - sent - there_s)
            self._control.hand(self._came, worker, sizes, took, job, result, way)

        job = Job(f"probe-{secrets.token_hex(4)}", "idp", self._payloads[sizes[0]])
        self._send(worker, job, _DEADLINE_S, done)

    def _came(
        self, worker: str, sizes: tuple[int, ...], took: dict[int, float], job: Job, result: Any, way: float
    ) -> None:
        self._asked.discard(worker)
        if worker not in self._here:
            return
        answer = checked_result(job, result) if isinstance(result, JobDone) else result
        if isinstance(answer, WrongAnswer):
            self._known.pop(worker, None)
            self._jobs.distrust(worker, answer.message)
            return
        if getattr(answer, "code", "") == UnknownKind.code:
            self._other.add(worker)
            self._jobs.cannot(worker, job.kind)
            self._jobs.heard(worker)
            return
        if not isinstance(answer, JobDone):
            log.debug("no sign of worker %s: %s", worker, answer)
            return
        self._jobs.heard(worker)
        took[sizes[0]] = min(took.get(sizes[0], way), way)
        if len(sizes) > 1:
            self._ask(worker, sizes[1:], took)
        elif _LARGE in took:
            byte_s = max(0.0, took[_LARGE] - took[_SMALL]) / answer_size(example("half", _LARGE))
            self._known[worker] = RoundTrip(took[_SMALL], byte_s)
            log.info("the way to worker %s takes %.2f ms and %.2f ns a byte", worker, took[_SMALL] * 1e3, byte_s * 1e9)


def _payload(n: int) -> bytes:
    return encode_shard(Shard(encode_ask(example("half", n)), 0, n))
