"""Waiting inserts into the solver, one step, the delta.  For one thread at a time: whoever has the map's InsertBatch.

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
from typing import Any, NamedTuple, cast

import numpy as np

from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch, Insert
from factorbus.proto.problems import Internal, Problem, TooLarge
from factorbus.service.config import Limits
from factorbus.service.core.events import Applied, Arrived, Outcome, ParsedInsert, SingleInsertResult, Stepped, Verdict
from factorbus.service.kernels.words import LETTERS, WORDS
from factorbus.service.kernels.write import write_messages
from factorbus.service.solving.holding import Broken, Holding
from factorbus.solver.changing import try_change, with_changes, with_converted
from factorbus.solver.divergence import check_step, copied, is_sound, is_usual, unstage
from factorbus.solver.errors import Diverged, SolverError

# The answer and the delta of one insert, if they are to be written in one piece; their reports count twice.
_ALONE_BYTES = 48 << 10

GOES_ON = "the map goes on converging, without an insert"

log = logging.getLogger(__name__)


class _Staged(NamedTuple):
    insert: Arrived
    first_factor: int
    settle: bool
    convert_below: float = 0.0


class _TakenBack(Exception):
    """A step with several inserts failed: the solver is as it was before them."""


class MapSolver(Holding):
    """The solver of one map, and how it takes in what comes.  For one thread at a time."""

    def __init__(
        self, make_solver: Callable[[], Any], epoch: int, limits: Limits, options: Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(make_solver, epoch, limits, options)
        self._cpu_s = 0.0  # of every thread that applied
        self._out = np.empty(_ALONE_BYTES, np.uint8)
        self._out_bytes = self._out.data
        self._pack = codec.report_encoder()
        self._fault_before: Exception | None = None  # a fault of the solver that is still to be dealt with

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
            judged = Verdict((Outcome(came.insert, came.answer, came.first_factor),), came.revision, 1)
            told = came.strategy, came.chi2, came.solver_ms
            left = {"converged": came.converged, "unfinished": came.unfinished}
            stepped = Stepped(came.revision, came.delta, *told, **left)
            return [judged, stepped], Applied(came.variables, came.factors, came.solver_cpu_s, came.now)
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
        """All that an InsertBatch asks for: `inserts`, or a `further` step where there are none."""
        if further:
            return self.go_on()
        return self.apply_single(inserts[0]) if len(inserts) == 1 else self.apply(inserts)

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
            report = self._solver.step()
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
        account = report.as_dict()
        account["because"] = f"{GOES_ON}: {report.because}"
        account["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._next(account)
        return [self._told(account)._replace(changed=report.changed, damping=report.damping)], False

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

    def _add(self, inserts: Sequence[Arrived]) -> Iterator[Verdict | Stepped]:
        """Inserts that only add: in one step, or one at a time where that fails."""
        try:
            yield from self._together(inserts)
        except _TakenBack:
            for insert in inserts:
                yield from self._together([insert])

    def _change(self, insert: Arrived) -> Iterator[Verdict | Stepped]:
        """One that changes what the map has: in place, or in a new solver; the map is as it was where that fails."""
        content, started = cast(Insert, insert.content), time.perf_counter()
        try:
            if self._broken:
                raise Broken(self._broken)
            self._check_room(insert.size, content.batch)
            # Numbers of unusual sizes are tried on another solver, as they are by inserts.
            came = None if self._wary else try_change(self._solver, content.changes, content.batch, content.settle)
        except (Problem, SolverError) as problem:
            yield Verdict((Outcome(insert, problem),))
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
            solver, first_factor, report, counted = with_changes(
                self._solver, content.changes, content.batch, content.settle
            )
            check_step(solver, report)
        except (Problem, SolverError) as problem:
            yield Verdict((Outcome(insert, problem),))
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
        content = cast(Insert, insert.content)
        staged = _Staged(insert, first_factor, content.settle, content.convert_below)
        yield from self._stepped([staged], [], report, started, counted, previous)
        if content.convert_below:
            yield from self._convert_to_points(content.convert_below)

    def apply_single(self, insert: Arrived) -> SingleInsertResult | Iterator[Verdict | Stepped | Applied]:
        """What `apply` comes to for one insert: in one piece where all goes as usual, in a third of the time.

        That time is mostly one of code that is not in the caches: so it is written in few calls.
        """
        content, solver, limits, most = insert.content, self._solver, self._limits, insert.size // 8
        variables, factors = self._held
        has_room = variables + most <= limits.variables and factors + most <= limits.factors
        if not isinstance(content, ParsedInsert) or self._broken or not has_room:
            return self.apply((insert,))
        started = time.perf_counter()
        try:
            first_factor = solver.try_stage(content.message, content.groups)
            if first_factor is None:
                return self.apply((insert,))
            if self._wary or not is_usual(solver, variables, factors):
                unstage(solver)
                return self.apply((insert,))
            report = solver.step(content.settle)
        except SolverError:
            return self.apply((insert,))  # it was taken back, and is now refused in the usual way
        except Exception as fault:
            self._fault_before = fault
            return self.apply((insert,))
        try:
            changed, graph = solver.pick_changed()
            if not is_sound(changed, graph, report):
                return self._diverged_alone(insert, report)
            account = report.as_dict()
            account["solver_ms"] = solver_ms = (time.perf_counter() - started) * 1e3
            account["converging"] = solver.unfinished or not report.converged
            answer, delta = write_messages(
                insert.sequence, self._epoch, self._revision + 1, first_factor, self._pack(account), changed,
                graph.var, graph.keys, graph.values, graph.stamps, WORDS, LETTERS, self._out,
            )  # fmt: skip
        except Exception:
            log.exception("the messages of a step could not be written in one piece")
            answer = 0
        if not answer:
            return self._in_pieces(_Staged(insert, first_factor, content.settle), report, started)
        self._next(account)
        self._held = variables, factors = variables + report.new_variables, factors + report.new_factors
        # By the clock, which a step without waiting comes to: to ask for the thread's time costs a call of the kernel.
        self._cpu_s += 1e-3 * solver_ms
        out = self._out_bytes
        return SingleInsertResult(
            insert, out[:answer].tobytes(), out[answer : answer + delta].tobytes(), first_factor, self._revision,
            report.strategy, report.chi2, solver_ms, variables, factors, self._cpu_s, time.monotonic(), self._converged,
            self._unfinished,
        )  # fmt: skip

    def _diverged_alone(self, insert: Arrived, report: Any) -> Iterator[Verdict | Stepped | Applied]:
        """The step of one insert left what cannot be kept: it is refused."""
        cpu_s = time.thread_time()
        problem = self._find_diverged(report)
        yield Verdict((Outcome(insert, problem or Internal("a step that was sound")),))
        yield from self._go_back(report)
        yield self._applied(cpu_s)

    def _find_diverged(self, report: Any) -> Diverged | None:
        """What the last step left beyond its bounds."""
        try:
            check_step(self._solver, report)
        except Diverged as diverged:
            return diverged
        return None

    def _in_pieces(self, staged: _Staged, report: Any, started: float) -> Iterator[Verdict | Stepped | Applied]:
        """The rest of `apply`, after the step."""
        cpu_s = time.thread_time()
        self._cpu_s += time.perf_counter() - started
        yield from self._stepped([staged], [], report, started)
        yield self._applied(cpu_s)

    def _applied(self, cpu_s: float) -> Applied:
        solver = self._solver
        self._cpu_s += time.thread_time() - cpu_s
        return Applied(solver.variable_count, solver.factor_count, self._cpu_s, time.monotonic())

    def _together(self, inserts: Sequence[Arrived]) -> Iterator[Verdict | Stepped]:
        """All of `inserts` in one step.  Raises _TakenBack, before anything else, if it failed with several staged."""
        started = time.perf_counter()
        staged: list[_Staged] = []
        outcomes: list[Outcome] = []
        fault, self._fault_before = self._fault_before, None
        kept: Any = None  # the solver as it was, where inserts are tried on a copy
        try:
            if fault is not None:
                raise fault
            for insert in inserts:
                try:
                    staged.append(self._stage(insert))
                except (Problem, SolverError) as problem:
                    outcomes.append(Outcome(insert, problem))
            if staged and (self._wary or not is_usual(self._solver, *self._held)):
                kept, self._solver = self._solver, copied(self._solver)
                staged = [self._stage(each.insert) for each in staged]
            report = self._solver.step(settle=any(s.settle for s in staged)) if staged else None
        except SolverError as problem:
            self._solver = kept or self._solver
            if len(staged) > 1:
                raise _TakenBack from problem
            report = None
            outcomes.append(Outcome(staged[0].insert, problem))
        except Exception:
            self._solver = kept or self._solver
            reference = self._fault()
            yield from self._replace_solver(reference)
            if len(inserts) > 1:
                raise _TakenBack from None
            report = None
            outcomes = [Outcome(inserts[0], Internal(reference))]
        diverged = None if report is None else self._find_diverged(report)
        if report is None:
            yield Verdict(tuple(outcomes))
        elif diverged is not None:
            if len(staged) == 1:
                yield Verdict((*outcomes, Outcome(staged[0].insert, diverged)))
            if kept is not None:
                self._solver = kept
            else:
                yield from self._go_back(report)
            if len(staged) > 1:
                raise _TakenBack
        else:
            self._wary = self._wary or kept is not None
            yield from self._stepped(staged, outcomes, report, started)
            if below := max((s.convert_below for s in staged), default=0.0):
                yield from self._convert_to_points(below)

    def _stage(self, insert: Arrived) -> _Staged:
        """Hand one insert to the solver.  Raises Problem, SolverError: then nothing changed."""
        content = insert.content
        if self._broken:
            raise Broken(self._broken)
        if isinstance(content, Problem):
            raise content
        if isinstance(content, ParsedInsert):
            if self._has_room(insert.size):
                first_factor = self._solver.try_stage(content.message, content.groups)
                if first_factor is not None:
                    return _Staged(insert, first_factor, content.settle)
            content = codec.decode_insert(content.message)
        self._check_room(insert.size, content.batch)
        return _Staged(insert, self._solver.stage(content.batch), content.settle, content.convert_below)

    def _has_room(self, size: int) -> bool:
        """Whether a message of `size` bytes surely keeps the map within its limits."""
        solver, limits = self._solver, self._limits
        most = size // 8  # a key is eight bytes: without counting, no more than this can be in it
        return solver.variable_count + most <= limits.variables and solver.factor_count + most <= limits.factors

    def _check_room(self, size: int, batch: Batch) -> None:
        """Raises TooLarge when the map would grow over its limits."""
        solver, limits = self._solver, self._limits
        if not self._has_room(size):
            for what, count, more, limit in (
                ("variables", solver.variable_count, batch.variable_count, limits.variables),
                ("factors", solver.factor_count, batch.factor_count, limits.factors),
            ):
                if count + more > limit:
                    raise TooLarge("the map with this insert", count + more, limit, what)

    def _stepped(
        self,
        staged: Sequence[_Staged],
        refused: Sequence[Outcome],
        report: Any,
        started: float,
        changed: Mapping[str, int] | None = None,
        previous: int | None = None,
    ) -> Iterator[Verdict | Stepped]:
        """The step went well: the answers, then the delta; previous: 0 where that has everything."""
        account = report.as_dict() | (changed or {})
        account["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._next(account)
        accepted = [
            Outcome(
                s.insert,
                codec.encode_accepted(
                    Accepted(s.insert.sequence, self._epoch, self._revision, s.first_factor, len(staged), account)
                ),
                s.first_factor,
            )
            for s in staged
        ]
        self._held = self._solver.variable_count, self._solver.factor_count
        yield Verdict((*accepted, *refused), self._revision, len(staged))
        try:
            told = self._told(account, previous)
        except Exception:
            # The step is done and answered; who misses its delta sees the gap.
            yield from self._replace_solver(self._fault())
        else:
            yield told

    def _convert_to_points(self, below: float) -> Iterator[Stepped]:
        """Features whose linearity index is below this become points, in a step of its own whose delta has everything.

        Where that step fails they stay what they are.
        """
        started = time.perf_counter()
        keys = self._solver.convertible(below)
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
        account = report.as_dict() | {"points": int(keys.size)}
        account["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._next(account)
        yield self._told(account, previous=0)
