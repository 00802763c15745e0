"""Waiting inserts into the solver, one step, the delta.  For one thread at a time: that with the map's InsertBatch.

    1  stage every insert; the solver refuses a bad one whole, the others go on
    2  one step for all of them
    3  if the step fails, nobody knows yet whose fault it is: the solver has taken all of them back, and they are
       tried again one at a time, so that only the guilty are refused
    4  a step that left anything that is not finite, or beyond its bounds, has failed as well (`divergence`)

An insert that changes what the map has, rather than only adding to it, is a step by itself.  Changes of factors are a
step of the solver as it is, if it can make them (`try_change`); for all others another solver is made with the
change in it, and takes the place of the old one if all went well.  The delta of that has the whole estimate.

Where the map is not at its optimum and nothing waits, a further step goes on, with nothing staged.

Where the solver itself fails it is replaced (see `holding`), and the insert that brought the fault about is refused as
internal.
"""

import logging
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from typing import Any, TypeAlias, cast

from factorbus.proto.messages import Insert
from factorbus.proto.problems import Internal, Problem
from factorbus.service.config import Limits
from factorbus.service.core.events import (
    Applied,
    Arrived,
    Outcome,
    ParsedInsert,
    SingleInsertResult,
    Stepped,
    Verdict,
    refusal,
)
from factorbus.service.solving.holding import Broken, Holding
from factorbus.solver.changes.convert_to_points import find_convertible
from factorbus.solver.changing import try_change, with_converted
from factorbus.solver.divergence import check_step, copied, find_diverged, is_elsewhere, is_usual, with_changes_within
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.columns import Columns
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import I64

WITHIN = "what was inserted before would run off, so this step stays within bounds"
GOES_ON = "the map goes on converging, without an insert"

log = logging.getLogger(__name__)


# Plain tuples, since a named one takes ten times as long to make.
_Staged: TypeAlias = tuple[Arrived, int]  # an insert that the solver has taken, and the id of its first factor
_Added: TypeAlias = tuple[Verdict, Sequence[Stepped]]  # what came of inserts, and the steps that were made


class _Undone(Exception):
    """A step with several inserts failed: the solver is as it was before them, by way of these steps."""

    def __init__(self, steps: Sequence[Stepped] = ()) -> None:
        self.steps = steps
        super().__init__()


class MapSolver(Holding):
    """The solver of one map, and how it takes in what comes.  For one thread at a time."""

    def __init__(
        self, make_solver: Callable[[], Any], epoch: int, limits: Limits, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(make_solver, epoch, limits, options)
        self._cpu_s = 0.0  # of every thread that applied

    def apply_again(
        self, inserts: Sequence[Arrived], rebuilt: bool = False, further: bool = False
    ) -> Iterator[Verdict | Stepped]:
        """Apply what was applied together before: no limit that has been set since refuses it.

        rebuilt: the solver was replaced meanwhile.  further: there was nothing, it was a further step.
        """
        limits, self._limits = self._limits, replace(self._limits, variables=1 << 62, factors=1 << 62)
        try:
            yield from self.apply_whole(inserts, further)[0] if inserts or further else ()
            if rebuilt:
                yield from self._replace_solver("replayed")
        finally:
            self._limits = limits

    def apply_whole(self, inserts: Sequence[Arrived], further: bool = False) -> tuple[list[Verdict | Stepped], Applied]:
        """All that comes of them, at its end.  Of the same inserts in the same groups always the same, to the bit."""
        came = self.apply_batch(inserts, further)
        if isinstance(came, SingleInsertResult):
            return [Verdict((came.outcome,), came.stepped.revision, 1), came.stepped], came.applied
        events: list[Verdict | Stepped] = []
        applied = self._applied(time.thread_time())
        for event in came:
            if isinstance(event, Applied):
                applied = event
            else:
                events.append(event)
        return events, applied

    def apply_batch(
        self, inserts: Sequence[Arrived], further: bool
    ) -> SingleInsertResult | Iterator[Verdict | Stepped | Applied]:
        """All that an InsertBatch asks for: `inserts`, or a `further` step where there are none.

        Of one insert that only adds, and is accepted, all of it in one.
        """
        if further:
            return self.go_on()
        if len(inserts) != 1 or inserts[0].is_change or getattr(inserts[0].content, "convert_below", 0.0):
            return self.apply(inserts)
        started = time.perf_counter()
        verdict, steps = self._add_together(inserts)
        # By the clock, which a step without waiting comes to: to ask for the thread's time costs a call of the kernel.
        self._cpu_s += time.perf_counter() - started
        applied = Applied(*self._accepted_counts, self._cpu_s, time.monotonic())
        if not verdict.together or len(steps) != 1 or steps[0].rebuilt:
            return iter((verdict, *steps, applied))
        return SingleInsertResult(verdict.outcomes[0], steps[0], applied)

    def go_on(self) -> Iterator[Stepped | Applied]:
        """One step without an insert: Stepped, unless the solver refuses it and is as it was; Applied."""
        cpu_s, revision, refused = time.thread_time(), self._revision, True
        stepped: list[Stepped] = []
        try:
            if not self._broken:
                stepped, refused = self._further_step()
        except Exception:
            self._revision = revision
            stepped = list(self._replace_solver(self._fault()))
            refused = not stepped
        yield from (each._replace(further=True) for each in stepped)
        yield self._applied(cpu_s)._replace(refused=refused)

    def _further_step(self) -> tuple[list[Stepped], bool]:
        """What comes of it, and whether it is refused.  As those of inserts, it is tried on a copy where numbers are of
        unusual sizes, and one that diverged all the same is undone in a step of its own."""
        started, kept, report = time.perf_counter(), None, None
        if self._wary or not is_usual(self._solver):
            kept, self._solver, self._wary = self._solver, copied(self._solver), True
        try:
            report = self._solver.step(budget=self._budget)
            check_step(self._solver, report)
        except SolverError as problem:
            log.warning("a further step, without an insert, is refused; none is tried until the next one: %s", problem)
            if kept is None and report is not None:
                return list(self._go_back(report)), True
            self._solver = kept or self._solver
            return [], True
        except Exception:
            self._solver = kept or self._solver
            raise
        reported = report.as_dict()
        reported["because"] = f"{GOES_ON}: {report.because}"
        reported["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._next(reported)
        return [self._published(reported)._replace(changed=report.changed, damping=report.damping)], False

    def apply(self, inserts: Sequence[Arrived]) -> Iterator[Verdict | Stepped | Applied]:
        """Apply `inserts`; every one of them is accepted or refused whole.

        Yields, for every step, Verdict (the answers, which stand whatever becomes of the delta) and Stepped; Applied at
        the end.
        """
        cpu_s = time.thread_time()
        for changing, group in groupby(inserts, lambda insert: insert.is_change):
            if changing:
                for insert in group:
                    yield from self._change(insert)
            else:
                yield from self._add(list(group))
        yield self._applied(cpu_s)

    def _applied(self, cpu_s: float) -> Applied:
        self._cpu_s += time.thread_time() - cpu_s
        return Applied(*self.size, self._cpu_s, time.monotonic())

    def _add(self, inserts: Sequence[Arrived]) -> Iterator[Verdict | Stepped]:
        """Inserts that only add: in one step, or one at a time where that fails."""
        try:
            verdict, steps = self._add_together(inserts)
        except _Undone as undone_steps:
            yield from undone_steps.steps
            for insert in inserts:
                yield from self._add([insert])
            return
        yield verdict
        yield from steps
        accepted = [outcome.insert.content for outcome in verdict.outcomes if outcome.first_factor >= 0]
        if below := max((cast(Insert, content).convert_below for content in accepted), default=0.0):
            yield from self._convert_to_points(below)

    def _add_together(self, inserts: Sequence[Arrived]) -> _Added:
        """All of `inserts` in one step.  Raises _Undone if it failed with several staged."""
        started = time.perf_counter()
        staged: list[_Staged] = []
        refused: list[Outcome] = []
        kept: Any = None  # the solver as it was, where inserts are tried on a copy
        counts, settle = self._accepted_counts, False
        try:
            for insert in inserts:
                try:
                    first_factor, counts = self._stage(insert, counts)
                    staged.append((insert, first_factor))
                    settle = settle or cast(Insert, insert.content).settle
                except (Problem, SolverError) as problem:
                    refused.append(refusal(insert, problem))
            if not staged:
                return Verdict(tuple(refused)), ()
            if self._wary or not is_usual(self._solver, *self._accepted_counts):
                kept, self._solver, counts = self._solver, copied(self._solver), self._accepted_counts
                for insert, _ in staged:
                    _, counts = self._stage(insert, counts)
            report = self._solver.step(settle, self._budget)
        except SolverError as problem:
            self._solver = kept or self._solver
            if len(staged) > 1:
                raise _Undone from problem
            return Verdict((*refused, refusal(staged[0][0], problem))), ()
        except Exception:
            self._solver = kept or self._solver
            reference = self._fault()
            steps = list(self._replace_solver(reference))
            if len(inserts) > 1:
                raise _Undone(steps) from None
            return Verdict((Outcome(inserts[0], Internal(reference)),)), steps
        try:
            changed, graph = self._solver.pick_changed()
            diverged = find_diverged(changed, graph, report)
        except Exception:
            return self._answered_only(staged, refused, self._report_of(report, started))
        if diverged is not None:
            elsewhere, steps = is_elsewhere(self._solver, report), list[Stepped]()
            if kept is not None:
                self._solver = kept
            else:
                steps = list(self._go_back(report))
            if len(staged) > 1:
                raise _Undone(steps)
            verdict = Verdict((refusal(staged[0][0], diverged),))
            if elsewhere:
                verdict, more = self._add_within(staged[0][0], diverged)
                steps += more
            return verdict._replace(outcomes=(*verdict.outcomes, *refused)), steps
        self._wary = self._wary or kept is not None
        return self._answered_and_published(staged, refused, self._report_of(report, started), (changed, graph))

    def _add_within(self, insert: Arrived, diverged: Problem | SolverError) -> _Added:
        """An insert whose step `diverged` where it has no part, made again: within the bounds, and on a copy."""
        started, kept = time.perf_counter(), self._solver
        try:
            self._solver = copied(kept)
            first_factor, _ = self._stage(insert, self._accepted_counts)
            with self._solver.within_bounds():
                report = self._solver.step(cast(Insert, insert.content).settle, self._budget)
            check_step(self._solver, report)
            changed = self._solver.pick_changed()
        except Exception as problem:
            if not isinstance(problem, Problem | SolverError):
                log.exception("the solver failed in a step within bounds; the map goes on without it")
            self._solver = kept
            return Verdict((refusal(insert, diverged),)), ()
        self._wary = True
        reported = self._report_of(report._replace(because=f"{WITHIN}: {report.because}"), started)
        return self._answered_and_published([(insert, first_factor)], (), reported, changed)

    def _stage(self, insert: Arrived, counts: tuple[int, int]) -> tuple[int, tuple[int, int]]:
        """Hand one insert to the solver, which holds `counts` variables and factors; gives the id of its first factor,
        and how many it holds then.  Raises Problem, SolverError: then nothing changed."""
        content = insert.content
        if self._broken:
            raise Broken(self._broken)
        if isinstance(content, ParsedInsert):
            counts = self._check_room(counts, content.variables, content.factors)
            return self._solver.stage(Columns(content.message, content.groups)), counts
        if isinstance(content, Problem):
            raise content
        counts = self._check_room(counts, content.batch.variable_count, content.batch.factor_count)
        self._solver.check_new_kinds(content.batch)
        return self._solver.stage(content.batch), counts

    def _answered_and_published(
        self, staged: Sequence[_Staged], refused: Sequence[Outcome], reported: dict[str, Any],
        changed: tuple[I64, FactorGraph], previous: int | None = None,
    ) -> _Added:  # fmt: skip
        """The step went well: the answers and the delta; previous: 0 where that has everything."""
        step = self._step(self._revision - 1 if previous is None else previous)
        try:
            *answers, delta = self._messages.write(_numbers(staged), step, reported, *changed)
        except Exception:
            return self._answered_only(staged, refused, reported)
        return self._accepted(staged, refused, answers), (self._stepped_to(delta),)

    def _answered_only(self, staged: Sequence[_Staged], refused: Sequence[Outcome], reported: dict[str, Any]) -> _Added:
        """The step is done and is answered, but its delta cannot be made: who misses it sees the gap."""
        answers = self._messages.write_answers(_numbers(staged), self._epoch, self._revision, reported)
        accepted = self._accepted(staged, refused, answers)
        return accepted, list(self._replace_solver(self._fault()))

    def _accepted(self, staged: Sequence[_Staged], refused: Sequence[Outcome], answers: Sequence[bytes]) -> Verdict:
        accepted = [Outcome(insert, answers[k], first_factor) for k, (insert, first_factor) in enumerate(staged)]
        return Verdict((*accepted, *refused), self._revision, len(staged))

    def _change(self, insert: Arrived) -> Iterator[Verdict | Stepped]:
        """One that changes what the map has: in place, or in a new solver; the map is as it was where that fails."""
        content, started = cast(Insert, insert.content), time.perf_counter()
        try:
            if self._broken:
                raise Broken(self._broken)
            self._check_room(self._accepted_counts, content.batch.variable_count, content.batch.factor_count)
            self._solver.check_new_kinds(content.batch)
            # Numbers of unusual sizes are tried on another solver, as they are by inserts.
            came = None if self._wary else try_change(self._solver, content.changes, content.batch, content.settle)
        except (Problem, SolverError) as problem:
            yield Verdict((refusal(insert, problem),))
            return
        except Exception:
            reference = self._fault()
            yield Verdict((Outcome(insert, Internal(reference)),))
            yield from self._replace_solver(reference)
            return
        if came is None:
            yield from self._change_anew(insert, started)
            return
        first_factor, report, counted = came
        self._wary = not is_usual(self._solver)
        yield from self._changed(insert, first_factor, report, started, counted, None)

    def _change_anew(self, insert: Arrived, started: float) -> Iterator[Verdict | Stepped]:
        """The same in a new solver."""
        content = cast(Insert, insert.content)
        try:
            solver, first_factor, report, counted = with_changes_within(
                self._solver, content.changes, content.batch, content.settle
            )
        except (Problem, SolverError) as problem:
            yield Verdict((refusal(insert, problem),))
            return
        except Exception:
            reference = secrets.token_hex(4)
            log.exception("fault %s: the solver failed in a change; the map goes on without it", reference)
            yield Verdict((Outcome(insert, Internal(reference)),))
            return
        self._solver, self._wary = solver, not is_usual(solver)
        yield from self._changed(insert, first_factor, report, started, counted, 0)

    def _changed(
        self, insert: Arrived, first_factor: int, report: Any, started: float, counted: Mapping[str, int],
        previous: int | None,
    ) -> Iterator[Verdict | Stepped]:  # fmt: skip
        """The step went well; previous: 0 where its delta is to have everything."""
        staged, reported = [(insert, first_factor)], self._report_of(report, started, counted)
        self._accepted_counts = self._solver.variable_count, self._solver.factor_count
        try:
            changed = self._solver.pick_changed()
        except Exception:
            verdict, steps = self._answered_only(staged, [], reported)
        else:
            verdict, steps = self._answered_and_published(staged, [], reported, changed, previous)
        yield verdict
        yield from steps
        if below := cast(Insert, insert.content).convert_below:
            yield from self._convert_to_points(below)

    def _convert_to_points(self, below: float) -> Iterator[Stepped]:
        """Features whose linearity index is below this become points, in a step of its own whose delta has everything.

        Where that step fails they stay what they are.
        """
        started = time.perf_counter()
        keys = find_convertible(self._solver.factor_graph, below)
        if not keys.size:
            return
        try:
            solver, report = with_converted(self._solver, keys)
            check_step(solver, report)
        except SolverError as problem:
            log.warning("%d features stay features: as points %s", keys.size, problem)
            return
        except Exception:
            log.exception("%d features stay features: the solver failed with them as points", keys.size)
            return
        self._solver = solver
        reported = report.as_dict() | {"points": int(keys.size)}
        reported["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._next(reported)
        yield self._published(reported, previous=0)


def _numbers(staged: Sequence[_Staged]) -> list[tuple[int, int]]:
    """Of each insert its sequence number and the id of its first factor."""
    return [(insert.sequence, first_factor) for insert, first_factor in staged]
