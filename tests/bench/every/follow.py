"""One drive by our solver: every step judged, and then the map is left alone until it is done."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver, StepReport

from .judge import FINE, Judge, Look

MOST_IDLE_S = 10.0  # a map left alone is given up after so long


@dataclass(frozen=True, slots=True)
class Seen:
    """One step: its number, how its estimate was judged, and what it said."""

    step: int
    look: Look
    report: StepReport


@dataclass(frozen=True, slots=True)
class Followed:
    """A drive and its rest.

    seen: the steps that were judged.  idle: those without anything new that followed, until one said `converged` and
    moved nothing; done: whether it came to that.  steps_s, idle_s: seconds that the solver took for each part.
    """

    seen: list[Seen]
    idle: list[Seen]
    done: bool
    steps_s: float
    idle_s: float


def follow(
    steps: Sequence[Batch], options: Options, every: int = 1, progress: Callable[[int], None] = lambda _: None
) -> Followed:
    """Replay; with `every`, judge only each so many-th step, those that say they have not converged, and the last."""
    solver, judge, seen, seconds = Solver(options), Judge(), [], 0.0
    for k, batch in enumerate(steps):
        start = time.perf_counter()
        solver.stage(batch)
        report = solver.step()
        seconds += time.perf_counter() - start
        judge.take_in(batch)
        if k % every == every - 1 or k == len(steps) - 1 or not report.converged:
            seen.append(Seen(k, judge.look(solver.estimate()), report))
        progress(k)
    idle, done, idle_s = _leave_alone(solver, judge, len(steps))
    return Followed(seen, idle, done, seconds, idle_s)


def _leave_alone(solver: Solver, judge: Judge, first: int) -> tuple[list[Seen], bool, float]:
    """Step without anything new, as a service does when nothing comes, until there is nothing left to do."""
    seen, done, seconds = [], False, 0.0
    while not done and seconds < MOST_IDLE_S:
        start = time.perf_counter()
        report = solver.step()
        seconds += time.perf_counter() - start
        seen.append(Seen(first + len(seen), judge.look(solver.estimate(), coarse=FINE), report))
        done = report.converged and not report.changed
    return seen, done, seconds
