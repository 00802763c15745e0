"""One drive by our solver: every step judged, and then the map is left alone until it is done."""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver, StepReport

from .judge import FINE, Judge, Look

MOST_IDLE = 1000  # steps without anything new


@dataclass(frozen=True, slots=True)
class Seen:
    """One step: its number, how it was judged, whether it said `converged`, and what it said in full."""

    step: int
    look: Look
    report: StepReport


@dataclass(frozen=True, slots=True)
class Rest:
    """A map left alone: how many steps without anything new until one said `converged` and moved nothing, the seconds
    they took together, how each was judged, and whether they came to an end."""

    steps: int
    seconds: float
    looks: list[Look]
    done: bool
    untrue: float


@dataclass(slots=True)
class Followed:
    """A whole drive."""

    seen: list[Seen] = field(default_factory=list)
    rest: Rest | None = None
    seconds: float = 0.0


def follow(
    batches: Iterable[Batch], options: Options, every: int = 1, progress: Callable[[int], None] = lambda _: None
) -> Followed:
    """Replay; with `every`, judge only each so many-th step, those that say they have not converged, and the last."""
    solver, judge, found = Solver(options), Judge(), Followed()
    steps = list(batches)
    for k, batch in enumerate(steps):
        start = time.perf_counter()
        solver.stage(batch)
        report = solver.step()
        found.seconds += time.perf_counter() - start
        judge.take_in(batch)
        if k % every == every - 1 or k == len(steps) - 1 or not report.converged:
            found.seen.append(Seen(k, judge.look(solver.estimate()), report))
        progress(k)
    found.rest = leave_alone(solver, judge)
    return found


def leave_alone(solver: Solver, judge: Judge) -> Rest:
    """Step without anything new, as a service does when nothing comes, until a step says that there is nothing to do."""
    seconds, looks, done, untrue = 0.0, [], False, 1.0
    while not done and len(looks) < MOST_IDLE:
        start = time.perf_counter()
        report = solver.step()
        seconds += time.perf_counter() - start
        looks.append(judge.look(solver.estimate(), coarse=FINE))
        done = report.converged and not report.changed
        if report.converged:
            untrue = max(untrue, looks[-1].ratio)
    return Rest(len(looks), seconds, looks, done, untrue)
