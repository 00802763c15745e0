"""Jobs on their way: to a worker, to the next one when that fails, in place when there is none, and back.

Everything here runs on one serial executor (the control thread); workers and the in-place threads only hand their
results to it.  No answer of a worker is passed on unchecked; what takes long to check is checked on an executor of its
own.
"""

import logging
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from factorbus.proto import codec
from factorbus.proto.messages import Job, JobDone, Optimum
from factorbus.proto.problems import Internal, Problem, ShuttingDown, Unavailable, UnknownKind, without_frames
from factorbus.service.jobs.dispatch import Dispatch, Distrusted, Effect, Ended, InPlace, Send
from factorbus.service.jobs.job_check import DoubtfulAnswer, WrongAnswer, checked_result, is_quick
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.questions.answers import as_variables
from factorbus.solver.errors import SolverError

log = logging.getLogger(__name__)

# For how long a worker that answered wrongly gets no job: the first time, and at most; it doubles.
_DISTRUST_S = (60.0, 3600.0)

# send(worker, job, deadline_s, done): done gets a JobDone or a problem, once, on any thread.
SendJob: TypeAlias = Callable[[str, Job, float, Callable[[Any], None]], None]


@dataclass(frozen=True, slots=True)
class _Open:
    ended: Callable[[Ended], None]
    deadline_s: float
    until: float
    timeout_s: float


class Jobs:
    """The jobs of one service.  For the control thread, which `control` must be."""

    def __init__(self, control: SerialExecutor, send: SendJob) -> None:
        self._control, self._send = control, send
        self._dispatch = Dispatch()
        self._open: dict[str, _Open] = {}
        self._in_place: dict[str, SerialExecutor] = {}  # by kind, started when first needed
        self._checks: SerialExecutor | None = None  # for answers that take long to check, started when first needed
        self._until: dict[str, float] = {}  # by worker that is distrusted

    def slots(self, kind: str) -> int:
        """Jobs of `kind` that workers take at a time now."""
        return self._dispatch.slots(kind)

    def free(self, kind: str) -> int:
        """Jobs of `kind` that a worker would begin at once."""
        return self._dispatch.free(kind)

    @property
    def wrong_answers(self) -> int:
        """Answers of workers that were wrong, since the service began."""
        return self._dispatch.wrong_answers

    @property
    def distrusted(self) -> list[str]:
        """Workers that get nothing at the moment because of what they answered."""
        return self._dispatch.distrusted

    @property
    def suspects(self) -> list[str]:
        """Workers that did not answer in time and have not been heard of since."""
        return self._dispatch.suspects

    def workers(self) -> list[dict[str, Any]]:
        """Who works here: rows of name, slots, jobs in flight, wrong answers, and whether it is distrusted."""
        return self._dispatch.table()

    def joined(self, worker: str, slots: int) -> None:
        """A worker announced itself; who was distrusted and begins anew is trusted."""
        self._until.pop(worker, None)
        log.info("worker %s joined with %d slots", worker, slots, extra={"worker": worker})
        self._perform(self._dispatch.joined(worker, slots))

    def left(self, worker: str) -> None:
        """A worker is gone."""
        self._until.pop(worker, None)
        log.info("worker %s left", worker, extra={"worker": worker})
        self._perform(self._dispatch.left(worker))

    def heard(self, worker: str) -> None:
        """A worker that was silent answers again."""
        self._perform(self._dispatch.heard(worker))

    def distrust(self, worker: str, why: str) -> None:
        """A worker answered a probe wrongly."""
        self._perform(self._dispatch.distrust(worker, why))

    def cannot(self, worker: str, kind: str) -> None:
        """A worker does no jobs of `kind`."""
        self._dispatch.cannot(worker, kind)

    def submit(
        self,
        kind: str,
        payload: bytes,
        ended: Callable[[Ended], None],
        deadline_s: float,
        timeout_s: float,
        ahead: int = 0,
    ) -> None:
        """Have a job done; `ended` gets what came of it, a JobDone or a problem, on the control thread.

        deadline_s: for one worker.  timeout_s: until it is given up, with Unavailable.  ahead: of short jobs, how many
        may wait at a worker.
        """
        job = Job(secrets.token_hex(8), kind, payload)
        self._open[job.job] = _Open(ended, deadline_s, time.monotonic() + timeout_s, timeout_s)
        self._perform(self._dispatch.submit(job, ahead))

    def tick(self) -> None:
        """Give up what has taken too long, and try again workers that have been distrusted for long enough."""
        now = time.monotonic()
        for worker in [worker for worker, until in self._until.items() if until < now]:
            del self._until[worker]
            log.info("worker %s gets jobs again", worker, extra={"worker": worker})
            self._perform(self._dispatch.trusted(worker))
        for job in [job for job, found in self._open.items() if found.until < now]:
            late = self._open[job].timeout_s
            self._give_up(job, Unavailable("the job", late, "allow more with timeout_s or add workers"))

    def close(self) -> None:
        """Refuse what is not done."""
        for job in list(self._open):
            self._give_up(job, ShuttingDown())

    def _give_up(self, job: str, problem: Problem) -> None:
        found = self._open.pop(job)
        self._dispatch.cancel(job)
        found.ended(Ended(job, "", problem))

    def _perform(self, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Send(tag, worker, job):
                    deadline_s = self._open[job.job].deadline_s
                    self._send(worker, job, deadline_s, lambda r, t=tag, j=job: self._answered(t, j, r))
                case InPlace(tag, job):
                    executor = self._in_place.get(job.kind) or SerialExecutor(f"in-place {job.kind}")
                    self._in_place[job.kind] = executor
                    executor.hand(self._do_in_place, tag, job)
                case Ended():
                    self._open.pop(effect.job).ended(effect)
                case Distrusted():
                    self._distrusted(effect)

    def _distrusted(self, effect: Distrusted) -> None:
        first_s, longest_s = _DISTRUST_S
        seconds = min(first_s * 2.0 ** (effect.times - 1), longest_s)
        self._until[effect.worker] = time.monotonic() + seconds
        log.warning(
            "worker %s %s; it gets no job for %g s, and what it had is done elsewhere: mend it and start it again",
            effect.worker, effect.why, seconds, extra={"worker": effect.worker},
        )  # fmt: skip

    def _answered(self, tag: int, job: Job, result: JobDone | Any) -> None:
        """On any thread."""
        if not isinstance(result, JobDone):
            self._control.hand(self._came, tag, result)
        elif is_quick(result):
            self._control.hand(self._judge, tag, job, result)
        else:
            self._control.hand(self._hand_to_checks, tag, job, result)

    def _hand_to_checks(self, tag: int, job: Job, result: JobDone) -> None:
        self._checks = self._checks or SerialExecutor("checks")
        self._checks.hand(lambda: self._control.hand(self._came, tag, checked_result(job, result)))

    def _judge(self, tag: int, job: Job, result: JobDone) -> None:
        self._came(tag, checked_result(job, result))

    def _came(self, tag: int, result: JobDone | Any) -> None:
        if isinstance(result, JobDone):
            effects = self._dispatch.done(tag, result)
        elif isinstance(result, DoubtfulAnswer):
            effects = self._dispatch.suspected(tag, result.message)
        elif isinstance(result, WrongAnswer):
            effects = self._dispatch.wrong(tag, result.message)
        else:
            effects = self._dispatch.failed(tag, result)
        self._perform(effects)

    def _do_in_place(self, tag: int, job: Job) -> None:
        """On an in-place executor."""
        self._control.hand(self._came, tag, do_here(job))


def do_here(job: Job) -> JobDone | Any:
    """What comes of `job` when the service does it itself: a JobDone or a problem."""
    try:
        return do_in_place(job)
    except (Problem, SolverError) as problem:
        return without_frames(problem)
    except Exception:
        reference = secrets.token_hex(4)
        log.exception("fault %s: job %s (%s) in place", reference, job.job, job.kind)
        return Internal(reference)


def do_in_place(job: Job) -> JobDone:
    """What a worker would answer to `job`, bit for bit.  Raises Problem, SolverError."""
    if job.kind not in _DO:
        raise UnknownKind("job.kind", job.kind, tuple(_DO))
    started = time.perf_counter()
    return JobDone(job.job, job.kind, _DO[job.kind](job.payload), time.perf_counter() - started)


def _batch(payload: bytes) -> bytes:
    from factorbus.solver import solve_batch

    graph = codec.decode_graph(payload)
    result = solve_batch(graph.batch.variables, graph.batch.factors)
    values = as_variables(result.values)
    optimum = Optimum(result.chi2, result.iterations, values, result.start, result.converged)
    return codec.encode_optimum(optimum)


def _idp(payload: bytes) -> bytes:
    from factorbus.idp import job as idp_job

    return idp_job.do(payload)


_DO = {"batch": _batch, "idp": _idp}
