"""Which worker gets which job, until when, and who is next when one fails.  Pure: the shell sends and times.

The worker with the fewest jobs in flight goes first; nobody gets more than it has slots for, but for short jobs, of
which one more may wait at the worker so that it need not wait for the next one's way.  A job whose worker
leaves, times out, answers nothing or fails goes to another one, and after `TRIES` of them, or when there is no
worker at all, it is done in place.  Jobs are pure functions of their payload, so two workers on one job do no harm;
every sending has a tag of its own, and an answer to any but the latest is dropped.

A worker that did not answer in time is a suspect: it may be frozen, and would cost every job that it is given another
deadline.  It gets nothing more until it is heard of again, in whatever way the shell finds out.

A worker whose answer cannot be right is distrusted: it gets nothing for a while, and its job goes to another one.  What
a worker says against the job itself (a refusal), and an answer that is doubtful, is not believed: the job is done in
place, and that decides; if it can be done, the worker is distrusted.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any, TypeAlias

from factorbus.proto.messages import Job, JobDone

TRIES = 3
# Codes with which a worker says nothing about the job: another worker, or a later try, may well succeed.
_TRY_ANOTHER = frozenset({"internal", "shutting_down", "busy", "unknown_kind", "too_large", "unavailable"})


@dataclass(frozen=True, slots=True)
class Send:
    """Send `job` to `worker`; what comes of it is reported under `tag`."""

    tag: int
    worker: str
    job: Job


@dataclass(frozen=True, slots=True)
class InPlace:
    """Do `job` here; what comes of it is reported under `tag`."""

    tag: int
    job: Job


@dataclass(frozen=True, slots=True)
class Ended:
    """`job` is done by `worker`, or cannot be done: result is a JobDone or a problem.

    tries: how often it was given to somebody; above 1, one who was given up may still be at it.
    """

    job: str
    worker: str
    result: JobDone | Any
    tries: int = field(default=1, compare=False)


@dataclass(frozen=True, slots=True)
class Distrusted:
    """`worker` gets no job until it is `trusted` again.  times: how often it has come to that since it joined."""

    worker: str
    why: str
    times: int


Effect: TypeAlias = Send | InPlace | Ended | Distrusted
IN_PLACE = "in-place"


@dataclass(slots=True)
class _Worker:
    slots: int
    tags: set[int] = field(default_factory=set)
    suspect: bool = False
    distrusted: bool = False
    wrong: int = 0  # answers
    times: int = 0  # distrusted
    cannot: set[str] = field(default_factory=set)  # kinds of jobs

    def takes(self, kind: str) -> bool:
        """Whether it is to get jobs of `kind`."""
        return not (self.suspect or self.distrusted or kind in self.cannot)


@dataclass(slots=True)
class _Open:
    """A job that is not done: where it was tried, and where it is (tag 0: waiting for a slot).

    suspected: by worker, what it said that doing the job in place is to decide.
    """

    job: Job
    ahead: int
    suspected: dict[str, str] = field(default_factory=dict)
    tried: set[str] = field(default_factory=set)
    tries: int = 0
    tag: int = 0


class Dispatch:
    """The workers there are and the jobs that are not done."""

    def __init__(self) -> None:
        self._workers: dict[str, _Worker] = {}
        self._jobs: dict[str, _Open] = {}
        self._by_tag: dict[int, tuple[str, str]] = {}  # tag -> (job, worker)
        self._waiting: deque[str] = deque()
        self._tags = count(1)
        self.wrong_answers = 0  # of all workers, since this began

    @property
    def open_jobs(self) -> int:
        """Jobs that are not done."""
        return len(self._jobs)

    def slots(self, kind: str) -> int:
        """Jobs of `kind` that workers take at a time now."""
        return sum(worker.slots for worker in self._workers.values() if worker.takes(kind))

    def free(self, kind: str) -> int:
        """Jobs of `kind` that would be begun at once."""
        idle = sum(max(0, w.slots - len(w.tags)) for w in self._workers.values() if w.takes(kind))
        return max(0, idle - len(self._waiting))

    @property
    def suspects(self) -> list[str]:
        """Workers that did not answer in time and have not been heard of since."""
        return [name for name, worker in self._workers.items() if worker.suspect]

    @property
    def distrusted(self) -> list[str]:
        """Workers that get nothing at the moment because of what they answered."""
        return [name for name, worker in self._workers.items() if worker.distrusted]

    def table(self) -> list[dict[str, Any]]:
        """Who works here: rows of name, slots, jobs in flight, wrong answers, and whether it is distrusted."""
        return [
            {"name": n, "slots": w.slots, "in_flight": len(w.tags), "wrong": w.wrong, "distrusted": w.distrusted}
            for n, w in sorted(self._workers.items())
        ]

    def joined(self, worker: str, slots: int) -> list[Effect]:
        """A worker announced itself; one that was known came back, and has forgotten its jobs."""
        effects = self.left(worker) if worker in self._workers else []
        self._workers[worker] = _Worker(max(1, slots))
        return effects + self._place_waiting()

    def left(self, worker: str) -> list[Effect]:
        """A worker is gone: its jobs go to others."""
        gone = self._workers.pop(worker, None)
        for tag in sorted(gone.tags, reverse=True) if gone else ():
            self._again(tag)
        return self._place_waiting()

    def heard(self, worker: str) -> list[Effect]:
        """`worker` answers: it is no suspect (any more)."""
        if worker in self._workers:
            self._workers[worker].suspect = False
        return self._place_waiting()

    def submit(self, job: Job, ahead: int = 0) -> list[Effect]:
        """A new job.  ahead: how many more than its slots a worker may have for this one to be sent there."""
        self._jobs[job.job] = _Open(job, ahead)
        self._waiting.append(job.job)
        return self._place_waiting()

    def cancel(self, job: str) -> None:
        """Nobody waits for `job` any more; a worker that has it is not disturbed, its answer will be dropped."""
        found = self._jobs.pop(job, None)
        if found is not None and found.tag == 0:
            self._waiting.remove(job)

    def done(self, tag: int, done: JobDone) -> list[Effect]:
        """The sending `tag` was answered, and the answer has been checked."""
        job, worker = self._release(tag)
        if not self._is_latest(job, tag):
            return self._place_waiting()
        found = self._jobs.pop(job)
        suspected = found.suspected.items() if worker == IN_PLACE else ()
        return [*self._distrust(suspected), Ended(job, worker, done, found.tries), *self._place_waiting()]

    def failed(self, tag: int, problem: Any) -> list[Effect]:
        """The sending `tag` was refused, timed out or came to nothing."""
        job, worker = self._by_tag.get(tag, ("", ""))
        known = self._workers.get(worker)
        if known is not None and problem.code == "unavailable":
            known.suspect = True
        if known is not None and problem.code == "unknown_kind" and job in self._jobs:
            known.cannot.add(self._jobs[job].job.kind)
        if worker != IN_PLACE and problem.code not in _TRY_ANOTHER:
            return self.suspected(tag, f"refused the job, which can be done: {problem.message} [{problem.code}]")
        if worker != IN_PLACE or not self._is_latest(job, tag):
            self._again(tag)
            return self._place_waiting()
        self._release(tag)
        tries = self._jobs.pop(job).tries
        return [Ended(job, worker, problem, tries), *self._place_waiting()]

    def suspected(self, tag: int, why: str) -> list[Effect]:
        """What the sending `tag` came to is not believed: the job is done in place next, and that decides."""
        job, worker = self._by_tag.get(tag, ("", ""))
        if self._is_latest(job, tag):
            self._jobs[job].suspected[worker] = why
        self._again(tag)
        return self._place_waiting()

    def wrong(self, tag: int, why: str) -> list[Effect]:
        """The answer to the sending `tag` cannot be right."""
        worker = self._by_tag.get(tag, ("", ""))[1]
        self._again(tag)
        return [*self._distrust([(worker, why)]), *self._place_waiting()]

    def distrust(self, worker: str, why: str) -> list[Effect]:
        """`worker` answered wrongly, to something that is no job of anybody's."""
        return self._distrust([(worker, why)])

    def trusted(self, worker: str) -> list[Effect]:
        """`worker` has been distrusted for long enough."""
        if worker in self._workers:
            self._workers[worker].distrusted = False
        return self._place_waiting()

    def cannot(self, worker: str, kind: str) -> None:
        """`worker` does no jobs of `kind`."""
        if worker in self._workers:
            self._workers[worker].cannot.add(kind)

    def _distrust(self, wrong: Iterable[tuple[str, str]]) -> list[Effect]:
        """Count the wrong answers (worker, why); who had been trusted until now is not any more."""
        effects: list[Effect] = []
        for name, why in wrong:
            self.wrong_answers += 1
            worker = self._workers.get(name)
            if worker is None:  # it has left
                continue
            worker.wrong += 1
            if not worker.distrusted:
                worker.distrusted, worker.times = True, worker.times + 1
                effects.append(Distrusted(name, why, worker.times))
        return effects

    def _is_latest(self, job: str, tag: int) -> bool:
        return job in self._jobs and self._jobs[job].tag == tag

    def _again(self, tag: int) -> None:
        """The sending `tag` came to nothing: its job, if that was its latest, goes first among those that wait."""
        job, _ = self._release(tag)
        if self._is_latest(job, tag):
            self._jobs[job].tag = 0
            self._waiting.appendleft(job)

    def _release(self, tag: int) -> tuple[str, str]:
        job, worker = self._by_tag.pop(tag, ("", ""))
        if worker in self._workers:
            self._workers[worker].tags.discard(tag)
        return job, worker

    def _place_waiting(self) -> list[Effect]:
        """Give away what waits, oldest first, as far as there are slots."""
        effects: list[Effect] = []
        for _ in range(len(self._waiting)):
            job = self._waiting.popleft()
            placed = self._place(self._jobs[job])
            if placed is None:
                self._waiting.append(job)
            else:
                effects.append(placed)
        return effects

    def _place(self, found: _Open) -> Effect | None:
        """Where it goes now; None: it waits for a slot."""
        untried: Mapping[str, _Worker] = {
            name: worker
            for name, worker in self._workers.items()
            if name not in found.tried and worker.takes(found.job.kind)
        }
        tag = next(self._tags)
        if found.suspected or found.tries >= TRIES or not untried:
            worker, effect = IN_PLACE, InPlace(tag, found.job)
        else:
            free = [name for name, worker in untried.items() if len(worker.tags) < worker.slots + found.ahead]
            if not free:
                return None
            worker = min(free, key=lambda name: (len(untried[name].tags), name))
            self._workers[worker].tags.add(tag)
            effect = Send(tag, worker, found.job)
        found.tried.add(worker)
        found.tries += 1
        found.tag = tag
        self._by_tag[tag] = (found.job.job, worker)
        return effect
