"""One drive by our solver: every step judged, and then the map is left alone until it is done."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

from bench.replays.chi2 import UNIT
from bench.replays.samples import sample_steps

from factorbus.proto.messages import Batch
from factorbus.solver import Group, Options, Solver, StepReport

from .judge import FINE, Judge, Look
from .oracle import Oracle

MOST_IDLE_S = 10.0  # a map left alone is given up after so long


@dataclass(frozen=True, slots=True)
class Seen:
    """One step: its number, how its estimate was judged, and what it said.

    before: χ² of the estimate before it, with its new factors; None where it brought variables that had none.
    """

    step: int
    look: Look
    report: StepReport
    before: float | None = None


@dataclass(frozen=True, slots=True)
class Followed:
    """A drive and its rest.

    seen: the steps that were judged.  idle: those without anything new that followed, until nothing was left to do;
    done: whether it came to that, with a report that says `converged`.  rest: where that ended.  steps_s, idle_s:
    seconds that the solver took for each part.  oracle_off: the most that judge and oracle differ, as a share of χ².
    """

    seen: list[Seen]
    idle: list[Seen]
    done: bool
    rest: Look
    steps_s: float
    idle_s: float
    oracle_off: float


def follow(steps: Sequence[Batch], options: Options, every: int = 1, check: int = 0) -> Followed:
    """Replay; with `every`, judge only its multiples, steps that say they have not converged, and the last.

    check: at this number of steps, spread, the oracle has to find the same optimum.
    """
    solver, judge, oracle, seen, seconds, off = Solver(options), Judge(), Oracle(), [], 0.0, 0.0
    checked = set(sample_steps(len(steps), check)) if check else set()
    for k, batch in enumerate(steps):
        before = None if batch.variables else solver.estimate()
        start = time.perf_counter()
        solver.stage(batch)
        report = solver.step()
        seconds += time.perf_counter() - start
        judge.take_in(batch)
        oracle.take_in(batch)
        if k in checked:
            off = max(off, _disagreement(judge, oracle, solver.estimate()))
        if k % every == every - 1 or k == len(steps) - 1 or not report.converged:
            seen.append(Seen(k, judge.look(solver.estimate()), report, judge.chi2(before) if before else None))
    idle, done, idle_s = _leave_alone(solver, judge, len(steps), seen[-1].report)
    rest = judge.look(solver.estimate(), coarse=FINE)
    return Followed(seen, idle, done, rest, seconds, idle_s, off)


def _disagreement(judge: Judge, oracle: Oracle, estimate: Sequence[Group]) -> float:
    """Of χ² at an estimate, and at the optimum from there; infinite where the oracle comes to none."""
    look = judge.look(estimate, coarse=FINE)
    try:
        other = oracle.optimum(estimate)
    except ArithmeticError:  # as in a mirrored map of ranges, whose χ² is a million times what it should be
        return math.inf
    pairs = zip((look.chi2, look.optimum), other, strict=True)
    return max(abs(mine - its) / max(its, UNIT) for mine, its in pairs)


def _leave_alone(solver: Solver, judge: Judge, first: int, report: StepReport) -> tuple[list[Seen], bool, float]:
    """Step without anything new, as a service does when nothing comes, until there is nothing left to do."""
    seen, seconds = [], 0.0
    while (solver.unfinished or not report.converged) and seconds < MOST_IDLE_S:
        before = solver.estimate()
        start = time.perf_counter()
        report = solver.step()
        seconds += time.perf_counter() - start
        look = judge.look(solver.estimate(), coarse=FINE)
        seen.append(Seen(first + len(seen), look, report, judge.chi2(before)))
    return seen, report.converged and not solver.unfinished, seconds
