"""New features for filters: a question is cut into shards, workers do them, the answer has them in order.

threads   Zenoh's      a question comes in: handed over
          features     reads it, decides, does small ones itself, puts answers together
          control         gives shards to workers and takes what comes of them
"""

import logging
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from factorbus.proto.features import Ask, Shard, answer_size
from factorbus.proto.features_codec import decode_ask, encode_answer, encode_shard
from factorbus.proto.limits import MessageLimits
from factorbus.proto.messages import Job, JobDone
from factorbus.proto.problems import Busy, Internal, Problem, ShuttingDown
from factorbus.service.core.events import Asker
from factorbus.service.jobs.dispatch import IN_PLACE, Ended
from factorbus.service.jobs.rates import measured
from factorbus.service.jobs.running import Jobs, do_here
from factorbus.service.jobs.sharding import Rates, Work, cuts, seconds, shards_for, work_of
from factorbus.service.jobs.worker_latency import WorkerLatency
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.questions.question_memory import COPIES, Room

log = logging.getLogger(__name__)

# A worker has so much longer than the shard should take, and this much besides: for one that is merely busy.
_PATIENCE, _BESIDES_S = 20.0, 1.0
# Nobody waits longer than this for features; every shard is done long before, in place if need be.
_GIVE_UP_S = 600.0
_UNBOUNDED = Room()


@dataclass(slots=True)
class _Question:
    """A question whose shards are being done; `parts` has what came, by shard."""

    asker: Asker
    parts: list[tuple[bytes, str, float] | None]
    clean: bool = True
    over: bool = False


@dataclass(frozen=True, slots=True)
class _Cutting:
    """A question that goes to workers, in at most `most` shards."""

    payload: bytes
    ask: Ask
    most: int
    work: Work
    rates: Rates


@dataclass(frozen=True, slots=True)
class FeatureLimits:
    """What a question for features may come to.

    messages: of one message   open: questions at a time   deadline_s: of a shard, at most   room: for answers
    """

    messages: MessageLimits
    open: int
    deadline_s: float
    room: Room = _UNBOUNDED


class FeatureQuestions:
    """The questions for features of one service.  Thread-safe: what is called from outside only hands over."""

    def __init__(
        self,
        control: SerialExecutor,
        jobs: Jobs,
        latencies: WorkerLatency,
        reply: Callable[[Asker, bytes], None],
        refuse: Callable[[Asker, Any], None],
        limits: FeatureLimits,
    ) -> None:
        self._control, self._jobs, self._latencies = control, jobs, latencies
        self._reply, self._refuse, self._limits = reply, refuse, limits
        self._rates: Rates | None = None
        self._open = 0  # on the control thread
        self._stopping = False
        self._executor = SerialExecutor("features")

    def measure(self) -> Rates:
        """Find out what computing takes here, before anybody asks."""
        self._rates = measured()
        return self._rates

    def ask(self, asker: Asker, payload: bytes) -> None:
        """A question came in."""
        if (waiting := self._executor.waiting) >= self._limits.open:
            self._refuse(asker, Busy(waiting, 0.05))
        else:
            self._executor.hand(self._take, asker, payload)

    def stop(self) -> None:
        """Refuse from now on; returns when all that was asked before is answered or handed to the control thread."""
        self._stopping = True
        reached = threading.Event()
        self._executor.hand(reached.set)
        reached.wait()

    def close(self) -> None:
        """Return when the answers that are ready are sent; after `stop`, and after the control thread is closed."""
        self._executor.close()

    # ---- on the features executor -----------------------------------------------------------------------------------

    def _take(self, asker: Asker, payload: bytes) -> None:
        try:
            if self._stopping:
                raise ShuttingDown
            ask = decode_ask(payload, self._limits.messages)
            self._check(ask)
            work, rates = work_of(ask), self._rates or self.measure()
            count = shards_for(work, rates, self._latencies.known, self._jobs.slots("idp"))
            if count == 0:
                self._here(asker, payload, ask.observations.count)
                return
        except Problem as problem:
            self._refuse(asker, problem)
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: features", reference)
            self._refuse(asker, Internal(reference))
        else:
            self._control.hand(self._submit, asker, _Cutting(payload, ask, count, work, rates))

    def _check(self, ask: Ask) -> None:
        """Is there room for the answer?  Raises TooLarge, OutOfMemory."""
        size, room = answer_size(ask), self._limits.room
        room.fits("the answer", size)
        room.check(COPIES * size)

    def _here(self, asker: Asker, payload: bytes, count: int) -> None:
        done = do_here(Job("in-place", "idp", encode_shard(Shard(payload, 0, count))))
        if isinstance(done, JobDone):
            self._reply(asker, encode_answer([(done.payload, IN_PLACE, done.seconds)], clean=True))
        else:
            self._refuse(asker, done)

    def _answer(self, question: _Question) -> None:
        self._reply(question.asker, encode_answer([part for part in question.parts if part], question.clean))

    # ---- on the control thread --------------------------------------------------------------------------------------

    def _submit(self, asker: Asker, cutting: _Cutting) -> None:
        if self._open >= self._limits.open:
            self._refuse(asker, Busy(self._open, 0.05))
            return
        self._open += 1
        # Into no more shards than are begun at once: a shard that waits only repeats what every shard does.
        count = min(cutting.most, max(1, self._jobs.free("idp")))
        deadline_s = min(self._limits.deadline_s, _BESIDES_S + _PATIENCE * seconds(cutting.work, cutting.rates, count))
        shards = [Shard(cutting.payload, first, last) for first, last in cuts(cutting.ask, count)]
        question = _Question(asker, [None] * len(shards))
        for place, shard in enumerate(shards):
            self._jobs.submit(
                "idp",
                encode_shard(shard),
                lambda job, place=place: self._came(question, place, job),
                deadline_s,
                _GIVE_UP_S,
                ahead=1,
            )

    def _came(self, question: _Question, place: int, job: Ended) -> None:
        question.clean &= job.tries == 1
        if question.over:
            return
        result = job.result
        if isinstance(result, JobDone):
            question.parts[place] = (result.payload, job.worker, result.seconds)
            if None in question.parts:
                return
            self._executor.hand(self._answer, question)
        else:
            self._refuse(question.asker, result)
        question.over = True
        self._open -= 1
