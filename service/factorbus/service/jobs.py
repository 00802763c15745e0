"""Batch optima: a question's snapshot becomes a job, somebody does it, the question gets its answer.

Everything here runs on one lane (the desk); workers and the in-place thread only hand their results to it.
"""

import logging
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from factorbus.proto import codec
from factorbus.proto.messages import Chi2, Job, JobDone
from factorbus.proto.problems import Busy, Internal, Problem, ShuttingDown, Unavailable
from factorbus.service import inplace
from factorbus.service.dispatch import Dispatch, Effect, Ended, InPlace, Send
from factorbus.service.events import Asker
from factorbus.service.lane import Lane
from factorbus.service.questions import Question, Snapshot
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

# send(worker, job, deadline_s, done): done gets a JobDone or a problem, once, on any thread.
SendJob: TypeAlias = Callable[[str, Job, float, Callable[[Any], None]], None]


@dataclass(frozen=True, slots=True)
class _Asked:
    asker: Asker
    question: Question
    epoch: int
    revision: int
    chi2: float
    until: float


class Jobs:
    """The jobs of one service.  For the desk lane, which `desk` must be."""

    def __init__(
        self,
        desk: Lane,
        send: SendJob,
        reply: Callable[[Asker, bytes], None],
        refuse: Callable[[Asker, Any], None],
        deadline_s: float,
        most: int,
    ) -> None:
        self._desk, self._send, self._reply, self._refuse = desk, send, reply, refuse
        self._deadline_s, self._most = deadline_s, most
        self._dispatch = Dispatch()
        self._asked: dict[str, _Asked] = {}
        self._in_place: Lane | None = None  # started when first needed

    def workers(self) -> list[dict[str, Any]]:
        """Who works here: rows of name, slots and jobs in flight."""
        return self._dispatch.table()

    def joined(self, worker: str, slots: int) -> None:
        """A worker announced itself."""
        log.info("worker %s joined with %d slots", worker, slots)
        self._perform(self._dispatch.joined(worker, slots))

    def left(self, worker: str) -> None:
        """A worker is gone."""
        log.info("worker %s left", worker)
        self._perform(self._dispatch.left(worker))

    def batch(self, asker: Asker, question: Question, taken: Snapshot) -> None:
        """Answer `question` with χ² and the batch optimum of the snapshot's graph."""
        if self._dispatch.open_jobs >= self._most:
            self._refuse(asker, Busy(self._dispatch.open_jobs, 1.0))
            return
        job = Job(secrets.token_hex(8), "batch", codec.encode_graph(taken.graph))
        until = time.monotonic() + question.timeout_s
        self._asked[job.job] = _Asked(asker, question, taken.epoch, taken.revision, taken.chi2, until)
        self._perform(self._dispatch.submit(job))

    def tick(self) -> None:
        """Give up what has taken too long."""
        now = time.monotonic()
        for job in [job for job, asked in self._asked.items() if asked.until < now]:
            asked = self._asked.pop(job)
            self._dispatch.cancel(job)
            self._refuse(
                asked.asker,
                Unavailable("the batch optimum", asked.question.timeout_s, "allow more with timeout_s or add workers"),
            )

    def close(self) -> None:
        """Refuse what is not done."""
        for job, asked in self._asked.items():
            self._dispatch.cancel(job)
            self._refuse(asked.asker, ShuttingDown())
        self._asked.clear()

    def _perform(self, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Send(tag, worker, job):
                    self._send(worker, job, self._deadline_s, lambda r, t=tag: self._desk.hand(self._came, t, r))
                case InPlace(tag, job):
                    self._in_place = self._in_place or Lane("in-place jobs")
                    self._in_place.hand(self._do_in_place, tag, job)
                case Ended(job, worker, result):
                    self._end(job, worker, result)

    def _came(self, tag: int, result: JobDone | Any) -> None:
        if isinstance(result, JobDone):
            self._perform(self._dispatch.done(tag, result))
        else:
            self._perform(self._dispatch.failed(tag, result))

    def _do_in_place(self, tag: int, job: Job) -> None:
        """On the in-place lane."""
        try:
            result: Any = inplace.do(job)
        except (Problem, SolverError) as problem:
            result = problem
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: job %s (%s) in place", reference, job.job, job.kind)
            result = Internal(reference)
        self._desk.hand(self._came, tag, result)

    def _end(self, job: str, worker: str, result: JobDone | Any) -> None:
        asked = self._asked.pop(job)
        if not isinstance(result, JobDone):
            self._refuse(asked.asker, result)
            return
        try:
            optimum = codec.decode_optimum(result.payload)
        except Problem as problem:
            self._refuse(asked.asker, problem)
            return
        self._reply(
            asked.asker,
            codec.encode_chi2(Chi2(asked.epoch, asked.revision, asked.chi2, optimum.chi2, worker, result.seconds)),
        )
