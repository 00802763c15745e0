"""Waiting inserts into the solver, one step, the delta.  All of it runs on the one thread that owns the map's solver.

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
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch, Delta, Factors, Insert, Variables
from factorbus.proto.problems import Internal, Problem, TooLarge
from factorbus.service.config import Limits
from factorbus.service.events import Folded, Outcome, Step, Waiting
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
    """The solver of one map, and what it is known to hold.  For one thread."""

    def __init__(self, make_solver: Callable[[], Any], epoch: int, limits: Limits) -> None:
        self._make, self._epoch, self._limits = make_solver, epoch, limits
        self._solver = make_solver()
        self._revision = 0
        self._held: Counter[Column] = Counter()  # accepted rows
        self._broken = ""
        self._steps: list[Step] = []

    def snapshot(self, questions: Sequence[Question]) -> Snapshot:
        """Copies of what `questions` need, at the present revision.  Raises Broken."""
        if self._broken:
            raise Broken(self._broken)
        return snapshot(self._solver, self._epoch, self._revision, questions)

    def fold(self, inserts: Sequence[Waiting]) -> Folded:
        """Fold `inserts` in; every one of them gets its outcome, accepted or refused whole."""
        self._steps = []
        try:
            outcomes = self._together(inserts)
        except _TakenBack:
            outcomes = [outcome for insert in inserts for outcome in self._together([insert])]
        solver = self._solver
        return Folded(
            tuple(self._steps),
            tuple(outcomes),
            solver.variable_count,
            solver.factor_count,
            time.thread_time(),
            time.monotonic(),
        )

    def _together(self, inserts: Sequence[Waiting]) -> list[Outcome]:
        """All of `inserts` in one step.  Raises _TakenBack when several were staged and the step failed."""
        started = time.perf_counter()
        staged: list[_Staged] = []
        outcomes: list[Outcome] = []
        try:
            for insert in inserts:
                try:
                    staged.append(self._stage(insert))
                except (Problem, SolverError) as problem:
                    outcomes.append(Outcome(insert, problem))
            if staged:
                settle = any(s.content.settle for s in staged)
                report = self._solver.step(settle=settle)
                outcomes += self._stepped(staged, report, started)
        except SolverError as problem:
            if len(staged) > 1:
                raise _TakenBack from problem
            outcomes.append(Outcome(staged[0].insert, problem))
        except Exception:
            reference = self._replace_solver()
            if len(inserts) > 1:
                raise _TakenBack from None
            return [Outcome(inserts[0], Internal(reference))]
        return outcomes

    def _stage(self, insert: Waiting) -> _Staged:
        """Hand one insert to the solver.  Raises Problem, SolverError: then nothing changed."""
        content = insert.content
        if self._broken:
            raise Broken(self._broken)
        if isinstance(content, Problem):
            raise content
        for what, count, more, limit in (
            ("variables", self._solver.variable_count, content.batch.variable_count, self._limits.variables),
            ("factors", self._solver.factor_count, content.batch.factor_count, self._limits.factors),
        ):
            if count + more > limit:
                raise TooLarge("the map with this insert", count + more, limit, what)
        return _Staged(insert, content, self._solver.stage(content.batch))

    def _stepped(self, staged: Sequence[_Staged], report: Any, started: float) -> list[Outcome]:
        """The step went well: make the delta and the answers, and only then count what is held."""
        account = report.as_dict() | {"solver_ms": (time.perf_counter() - started) * 1e3}
        step = self._told(self._solver, account)
        outcomes = [
            Outcome(
                s.insert,
                codec.encode_accepted(
                    Accepted(s.insert.sequence, self._epoch, step.revision, s.first_factor, len(staged), account)
                ),
            )
            for s in staged
        ]
        self._commit(step, (s.content.batch for s in staged))
        return outcomes

    def _told(self, solver: Any, account: dict[str, Any]) -> Step:
        """The step that `solver` made last, with its delta from the present revision."""
        revision = self._revision + 1
        changed = as_variables(solver.changed())
        delta = codec.encode_delta(Delta(self._epoch, revision, self._revision, changed, account))
        return Step(revision, delta, account["strategy"], account["chi2"], account["solver_ms"])

    def _commit(self, step: Step, batches: Iterable[Batch]) -> None:
        for batch in batches:
            _count_rows(batch, self._held)
        self._steps.append(step)
        self._revision = step.revision

    def _replace_solver(self) -> str:
        """A new solver with what had been accepted.  Returns the reference under which the fault is logged."""
        reference = secrets.token_hex(4)
        log.exception("fault %s: the solver failed; starting a new one with what had been accepted", reference)
        try:
            self._rebuild()
        except Exception:
            self._broken = reference
            log.exception("fault %s: what had been accepted could not be brought back; the map is broken", reference)
        return reference

    def _rebuild(self) -> None:
        """The accepted rows of every column are its first ones: whatever a failed insert left is behind them."""
        variables, factors = self._solver.graph()
        kept = Batch(
            tuple(_first(group, self._held[group.kind, group.fixed]) for group in as_variables(variables)),
            tuple(_first_factors(group, self._held[group.kind, None]) for group in as_factors(factors)),
        )
        found: Counter[Column] = Counter()
        _count_rows(kept, found)
        if +found != +self._held:
            raise ValueError(f"the failed solver holds {dict(found)}; accepted were {dict(self._held)}")
        fresh = self._make()
        if self._held:
            started = time.perf_counter()
            fresh.stage(kept)
            report = fresh.step()
            account = report.as_dict() | {"solver_ms": (time.perf_counter() - started) * 1e3}
            self._commit(self._told(fresh, account), ())
        self._solver = fresh


def _count_rows(batch: Batch, rows: Counter[Column]) -> None:
    """Count into `rows` what `batch` adds to each column of a graph."""
    for group in batch.variables:
        rows[group.kind, group.fixed] += len(group.keys)
    for group in batch.factors:
        rows[group.kind, None] += len(group.keys)


def _first(group: Variables, count: int) -> Variables:
    values = None if group.values is None else group.values[:count]
    if values is None or not np.isfinite(values).all():
        raise ValueError(f"the failed solver's values of {group.kind} are not finite")
    return Variables(group.kind, group.keys[:count], values, group.fixed)


def _first_factors(group: Factors, count: int) -> Factors:
    return Factors(group.kind, group.keys[:count], group.measured[:count], group.information[:count])
