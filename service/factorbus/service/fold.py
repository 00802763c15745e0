"""Waiting inserts into the solver, one step, the delta.  For one thread at a time: whoever has the map's Run.

    1  stage every insert; the solver refuses a bad one whole, the others go on
    2  one step for all of them
    3  if the step fails, nobody knows yet whose fault it is: the solver has taken all of them back, and they are
       tried again one at a time, so that only the guilty are refused

A fault of the solver itself (anything but SolverError) leaves it in a state nobody can vouch for.  It is replaced by
a new one with the content that had been accepted, which is append-only and counted here, and the whole estimate is
published again; the insert that brought the fault about is refused as internal.
"""

import logging
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch, Delta, Factors, Insert, Variables
from factorbus.proto.problems import Internal, Problem, TooLarge
from factorbus.service.config import Limits
from factorbus.service.events import Folded, Judged, Outcome, Stepped, Waiting
from factorbus.service.questions import Question, Snapshot, as_factors, as_variables, snapshot
from factorbus.solver.errors import SolverError

# A kind of variables and whether they are fixed, or a kind of factors and None.
Column: TypeAlias = tuple[str, bool | None]

log = logging.getLogger(__name__)


class Broken(Problem):
    """The solver failed and its content could not be brought back: the map answers nothing more."""

    code = "internal"

    def __init__(self, reference: str) -> None:
        super().__init__(
            f"the map is broken since fault {reference} (see the service's log); drop it and insert again",
            reference=reference,
        )


@dataclass(frozen=True, slots=True)
class _Staged:
    insert: Waiting
    content: Insert
    first_factor: int


class _TakenBack(Exception):
    """A step with several inserts failed: the solver is as it was before them."""


class Folder:
    """The solver of one map, and what it is known to hold.  For one thread at a time."""

    def __init__(self, make_solver: Callable[[], Any], epoch: int, limits: Limits) -> None:
        self._make, self._epoch, self._limits = make_solver, epoch, limits
        self._solver = make_solver()
        self._revision = 0
        self._cpu_s = 0.0  # of every thread that folded
        self._held: dict[Column, int] = {}  # accepted rows
        self._broken = ""

    def snapshot(self, questions: Sequence[Question]) -> Snapshot:
        """Copies of what `questions` need, at the present revision.  Raises Broken."""
        if self._broken:
            raise Broken(self._broken)
        return snapshot(self._solver, self._epoch, self._revision, questions)

    def fold(self, inserts: Sequence[Waiting]) -> Iterator[Judged | Stepped | Folded]:
        """Fold `inserts` in; every one of them is accepted or refused whole.

        Yields, for every step, Judged (the answers, which stand whatever becomes of the delta) and Stepped; Folded at
        the end.
        """
        cpu_s = time.thread_time()
        try:
            yield from self._together(inserts)
        except _TakenBack:
            for insert in inserts:
                yield from self._together([insert])
        solver = self._solver
        self._cpu_s += time.thread_time() - cpu_s
        yield Folded(solver.variable_count, solver.factor_count, self._cpu_s, time.monotonic())

    def _together(self, inserts: Sequence[Waiting]) -> Iterator[Judged | Stepped]:
        """All of `inserts` in one step.  Raises _TakenBack, before anything else, if it failed with several staged."""
        started = time.perf_counter()
        staged: list[_Staged] = []
        outcomes: list[Outcome] = []
        try:
            for insert in inserts:
                try:
                    staged.append(self._stage(insert))
                except (Problem, SolverError) as problem:
                    outcomes.append(Outcome(insert, problem))
            report = self._solver.step(settle=any(s.content.settle for s in staged)) if staged else None
        except SolverError as problem:
            if len(staged) > 1:
                raise _TakenBack from problem
            report = None
            outcomes.append(Outcome(staged[0].insert, problem))
        except Exception:
            reference = self._fault()
            yield from self._replace_solver(reference)
            if len(inserts) > 1:
                raise _TakenBack from None
            report = None
            outcomes = [Outcome(inserts[0], Internal(reference))]
        if report is None:
            yield Judged(tuple(outcomes))
        else:
            yield from self._stepped(staged, outcomes, report, started)

    def _stage(self, insert: Waiting) -> _Staged:
        """Hand one insert to the solver.  Raises Problem, SolverError: then nothing changed."""
        content = insert.content
        if self._broken:
            raise Broken(self._broken)
        if isinstance(content, Problem):
            raise content
        self._check_room(insert.size, content.batch)
        return _Staged(insert, content, self._solver.stage(content.batch))

    def _check_room(self, size: int, batch: Batch) -> None:
        """Raises TooLarge when the map would grow over its limits."""
        solver, limits = self._solver, self._limits
        most = size // 8  # a key is eight bytes: without counting, no more than this can be in it
        if solver.variable_count + most > limits.variables or solver.factor_count + most > limits.factors:
            for what, count, more, limit in (
                ("variables", solver.variable_count, batch.variable_count, limits.variables),
                ("factors", solver.factor_count, batch.factor_count, limits.factors),
            ):
                if count + more > limit:
                    raise TooLarge("the map with this insert", count + more, limit, what)

    def _stepped(
        self, staged: Sequence[_Staged], refused: Sequence[Outcome], report: Any, started: float
    ) -> Iterator[Judged | Stepped]:
        """The step went well: the answers, then the delta."""
        account = report.as_dict()
        account["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._revision += 1
        accepted = [
            Outcome(
                s.insert,
                codec.encode_accepted(
                    Accepted(s.insert.sequence, self._epoch, self._revision, s.first_factor, len(staged), account)
                ),
            )
            for s in staged
        ]
        for s in staged:
            _count_rows(s.content.batch, self._held)
        yield Judged((*accepted, *refused))
        try:
            told = self._told(account)
        except Exception:
            # The step is done and answered; who misses its delta sees the gap.
            yield from self._replace_solver(self._fault())
        else:
            yield told

    def _told(self, account: dict[str, Any]) -> Stepped:
        """The solver's last step, with its delta; what it takes to find out what changed is the solver's time, too."""
        started = time.perf_counter()
        changed = self._solver.changed()
        account["solver_ms"] += (time.perf_counter() - started) * 1e3
        delta = codec.encode_delta(Delta(self._epoch, self._revision, self._revision - 1, tuple(changed), account))
        return Stepped(self._revision, delta, account["strategy"], account["chi2"], account["solver_ms"])

    def _fault(self) -> str:
        """Log what is being handled; the reference under which it is found."""
        reference = secrets.token_hex(4)
        log.exception("fault %s: the solver failed; starting a new one with what had been accepted", reference)
        return reference

    def _replace_solver(self, reference: str) -> Iterator[Stepped]:
        """A new solver with what had been accepted, and the step that brought it there."""
        try:
            account = self._rebuild()
            if account is not None:
                self._revision += 1
                yield self._told(account)
        except Exception:
            self._broken = reference
            log.exception("fault %s: what had been accepted could not be brought back; the map is broken", reference)

    def _rebuild(self) -> dict[str, Any] | None:
        """The accepted rows of every column are its first ones: whatever a failed insert left is behind them."""
        variables, factors = self._solver.graph()
        kept = Batch(
            tuple(_first(group, self._held.get((group.kind, group.fixed), 0)) for group in as_variables(variables)),
            tuple(_first_factors(group, self._held.get((group.kind, None), 0)) for group in as_factors(factors)),
        )
        found: dict[Column, int] = {}
        _count_rows(kept, found)
        if {column: n for column, n in found.items() if n} != self._held:
            raise ValueError(f"the failed solver holds {found}; accepted were {self._held}")
        fresh, started = self._make(), time.perf_counter()
        account = None
        if self._held:
            fresh.stage(kept)
            account = fresh.step().as_dict()
            account["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._solver = fresh
        return account


def _count_rows(batch: Batch, rows: dict[Column, int]) -> None:
    """Count into `rows` what `batch` adds to each column of a graph."""
    for group in batch.variables:
        column = (group.kind, group.fixed)
        rows[column] = rows.get(column, 0) + len(group.keys)
    for group in batch.factors:
        column = (group.kind, None)
        rows[column] = rows.get(column, 0) + len(group.keys)


def _first(group: Variables, count: int) -> Variables:
    values = None if group.values is None else group.values[:count]
    if values is None or not np.isfinite(values).all():
        raise ValueError(f"the failed solver's values of {group.kind} are not finite")
    return Variables(group.kind, group.keys[:count], values, group.fixed)


def _first_factors(group: Factors, count: int) -> Factors:
    return Factors(group.kind, group.keys[:count], group.measured[:count], group.information[:count])
