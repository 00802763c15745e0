"""The solver of one map, and what it is known to hold: questions to it, copies, and another one in its place.

A fault of the solver itself (anything but SolverError) leaves it in a state nobody can vouch for.  It is replaced by
a new one with the content that had been accepted, which comes first and is counted here, and the whole estimate is
published again.
"""

import logging
import secrets
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.budget import BUDGET_OPTION
from factorbus.proto.closures import Suspects, encode_suspects
from factorbus.proto.keep import KEEP_ALL, KEEP_OPTION, try_keep
from factorbus.proto.problems import Problem, TooLarge
from factorbus.service.config import Limits
from factorbus.service.core.budget import use_of
from factorbus.service.core.events import Arrived, Stepped
from factorbus.service.core.removals import Planned
from factorbus.service.questions.answers import Copied, Question, QuestionCopies, snapshot
from factorbus.service.questions.question_memory import Room
from factorbus.service.questions.uncertainty import Uncertain
from factorbus.service.solving.messages import StepMessages
from factorbus.service.solving.planning import NOTHING_STAYS, plan_insert
from factorbus.solver.divergence import check_step, is_usual, undone

# Until a copy of a map is at work there are the state on its way, the same as bytes of a file, and the copy itself;
# each up to twice what the solver has in use, as arrays double when they grow (measured: 1.7 times for 10,000 poses).
_COPIES = 6
_NOTHING: Mapping[str, int] = {}
_FULL = "go on in another map, or raise the limit"

log = logging.getLogger(__name__)


class Broken(Problem):
    """The solver failed and its content could not be brought back: the map answers nothing more."""

    code = "internal"

    def __init__(self, reference: str) -> None:
        super().__init__(
            f"the map is broken since fault {reference} (see the service's log); drop it and insert again",
            reference=reference,
        )


class Holding:
    """A solver with its revision and what had been accepted.  For one thread at a time."""

    def __init__(
        self, make_solver: Callable[[], Any], epoch: int, limits: Limits, options: Mapping[str, Any] | None = None
    ) -> None:
        self._options = dict(options or {})
        self._make, self._epoch, self._limits = make_solver, epoch, limits
        self._solver: Any = make_solver()
        self._revision = 0
        self._last_report: dict[str, Any] = {}  # of the last step
        self._uncertain: Uncertain | None = None  # R at this revision, if somebody asked
        self._accepted_counts = (0, 0)  # variables and factors that were accepted
        self._converged, self._unfinished = True, False
        self._broken = ""
        self._wary = False  # the map has numbers of unusual sizes: what comes is tried on a copy
        self._room = Room()
        self._messages = StepMessages()
        self._budget: float | None = None  # of every step, as `Solver.step` has it
        self._budget_ms = 0.0  # what that is of, for reports; 0: not said

    def allow(self, budget: float, budget_ms: float | None = None) -> None:
        """What each step of what is applied next may take, in units of work; 0: as the solver's own settings say.

        budget_ms: what that is of; None: what the map's settings say.
        """
        self._budget = budget or None
        self._budget_ms = float(self._options.get(BUDGET_OPTION, 0.0)) if budget_ms is None else budget_ms

    def change_budget(self, budget_ms: float) -> None:
        """The map's settings say this from now on.  From any thread: what it has is given with each `allow`."""
        others = {name: value for name, value in self._options.items() if name != BUDGET_OPTION}
        self._options = others | ({BUDGET_OPTION: budget_ms} if budget_ms else {})

    def bound(self, room: Room) -> None:
        """Questions may take no more than this."""
        self._room = room

    def snapshot(self, questions: Sequence[Question]) -> QuestionCopies:
        """Copies of what `questions` need, at the present revision.  Raises Broken."""
        if self._broken:
            raise Broken(self._broken)
        taken = snapshot(
            self._solver, self._epoch, self._revision, questions, self._last_report, self._uncertain, self._room
        )
        self._uncertain = taken.uncertain
        if asked := {id(q): self.suspects(q.ask.every) for q in questions if q.name == "suspects"}:
            taken = replace(taken, ready={**taken.ready, **asked})
        rooms = [question.ask.room for question in questions if question.name == "copy"]
        return replace(taken, copied=self._copied(min(rooms))) if rooms else taken

    def closure_counts(self) -> dict[str, int] | None:
        """How many loop closures are in each state; None: they are not tested."""
        return None

    def suspects(self, every: bool) -> bytes:
        """The answer to ask/suspects; `every`: of all closures.  Where they are not tested there are none."""
        del every
        return encode_suspects(Suspects(self._epoch, self._revision, "trust"))

    def plan_removals(self) -> tuple[Planned, tuple[Arrived, ...]]:
        """What goes next by the policy of the map, and the insert that does it; of a broken map, nothing."""
        keep = try_keep(str(self._options.get(KEEP_OPTION, KEEP_ALL)))
        if keep is None or self._broken:
            return Planned(0), ()
        return plan_insert(self._solver.factor_graph, keep, self._staying(), self._revision + 1)

    def _staying(self) -> I64:
        """Keys of poses that stay whatever the policy says."""
        return NOTHING_STAYS

    def options(self) -> dict[str, Any]:
        """The settings of its solver."""
        return self._options

    @property
    def revision(self) -> int:
        """Steps that were made."""
        return self._revision

    @property
    def size(self) -> tuple[int, int]:
        """Variables and factors."""
        return self._solver.variable_count, self._solver.factor_count

    def chi2(self) -> float:
        """Σ rᵀ Ω r at the estimate."""
        return float(self._solver.chi2())

    @property
    def converged(self) -> bool:
        """Whether the last step had; of an empty map, it has."""
        return self._converged

    @property
    def unfinished(self) -> bool:
        """Whether a further step would bring the estimate nearer to its optimum."""
        return self._unfinished

    @property
    def complete(self) -> bool:
        """Whether the last step left nothing for later ones."""
        return bool(self._solver.complete)

    def enter(self, epoch: int) -> None:
        """From now on answers and deltas name this epoch."""
        self._epoch = epoch

    def dump(self) -> dict[str, Any]:
        """All that later records depend on, a copy.  Raises Broken."""
        if self._broken:
            raise Broken(self._broken)
        state = {"revision": self._revision, "held": list(self._accepted_counts), "converged": self._converged}
        return {"solver": self._solver.dump()} | state

    def _copied(self, room: int) -> Copied:
        """All of it, if another map_solver and what lies between them fit into this number of bytes."""
        size = _COPIES * self.memory_bytes()
        return Copied(self.dump() if size <= room else None, size)

    def load(self, state: Mapping[str, Any] | None) -> bool:
        """Be where the one was that gave `state`; None: where a new one is.  Gives whether that is so to the bit.

        Raises ValueError, KeyError, SolverError.
        """
        self._solver, self._revision, self._broken, self._wary = self._make(), 0, "", False
        self._accepted_counts, self._converged, self._unfinished = (0, 0), True, False
        if state is None:
            return True
        anew = self._solver.load(state["solver"])
        if anew is not None:
            check_step(self._solver, anew)
        self._wary = not is_usual(self._solver)
        self._revision = int(state["revision"])
        self._accepted_counts = tuple(state["held"])
        self._converged = bool(state["converged"] if anew is None else anew.converged)
        self._unfinished = bool(self._solver.unfinished)
        return anew is None

    def count_from(self, revision: int) -> None:
        """The last step led to this revision, as a journal has it of another build, which took more steps or fewer."""
        self._revision = revision

    @property
    def solver(self) -> Any:
        """To see whether it was replaced."""
        return self._solver

    def whole_estimate(self, told: Mapping[str, Any]) -> Stepped:
        """The whole estimate as the delta of the last step, whose report says what is `told`, too."""
        reported = {**self._last_report, **told}
        _, graph = self._solver.pick_changed()
        everything = np.arange(self._solver.variable_count)
        delta = self._messages.write_delta(self._step(0), reported, everything, graph)
        strategy, solver_ms = str(reported.get("strategy", "")), float(reported.get("solver_ms", 0.0))
        made = Stepped(self._revision, delta, strategy, self.chi2(), solver_ms)
        return made._replace(converged=self._converged, unfinished=self._unfinished, **_kept_of(reported))

    def _check_room(self, counts: tuple[int, int], variables: int, factors: int) -> tuple[int, int]:
        """How many variables and factors the map has with these.  Raises TooLarge beyond its limits."""
        limits, with_them = self._limits, (counts[0] + variables, counts[1] + factors)
        if with_them[0] > limits.variables:
            raise TooLarge("the map with this insert", with_them[0], limits.variables, "variables", _FULL)
        if with_them[1] > limits.factors:
            raise TooLarge("the map with this insert", with_them[1], limits.factors, "factors", _FULL)
        return with_them

    def _report_of(self, report: Any, started: float, counted: Mapping[str, int] = _NOTHING) -> dict[str, Any]:
        """What the answers and the delta of a step say of it; the map is at its revision then."""
        reported = report.as_dict()
        reported.update(counted)
        reported["solver_ms"] = (time.perf_counter() - started) * 1e3
        self._next(reported)
        variables, factors = self._accepted_counts
        self._accepted_counts = variables + report.new_variables, factors + report.new_factors
        return reported

    def memory_bytes(self) -> int:
        """What its solver has in use."""
        return int(self._solver.memory_bytes())

    def _published(self, reported: dict[str, Any], previous: int | None = None) -> Stepped:
        """The solver's last step, with its delta; what it takes to find out what changed is the solver's time, too."""
        previous = self._revision - 1 if previous is None else previous
        started = time.perf_counter()
        changed, graph = self._solver.pick_changed()
        reported["solver_ms"] += (time.perf_counter() - started) * 1e3
        return self._stepped_to(self._messages.write_delta(self._step(previous), reported, changed, graph))

    def _step(self, previous: int) -> tuple[int, int, int]:
        """Epoch and revision of the last step, and the one before."""
        return self._epoch, self._revision, previous

    def _stepped_to(self, delta: bytes) -> Stepped:
        """The last step, which `delta` tells of."""
        reported = self._last_report
        told = reported["strategy"], reported["chi2"], reported["solver_ms"]
        made = Stepped(self._revision, delta, *told, converged=self._converged, unfinished=self._unfinished)
        made = made._replace(**_kept_of(reported))
        return made._replace(use=use_of(reported)) if "budget" in reported else made

    def _next(self, reported: dict[str, Any]) -> None:
        """The solver has made a step: `reported` says, too, whether more are to follow."""
        self._revision += 1
        self._last_report, self._uncertain = reported, None
        self._converged, self._unfinished = _has_converged(reported), bool(self._solver.unfinished)
        reported["converging"] = self._unfinished or not self._converged
        if "budget" in reported and self._budget_ms:
            reported["budget_ms"] = self._budget_ms

    def _fault(self) -> str:
        """Log what is being handled; the reference under which it is found."""
        reference = secrets.token_hex(4)
        log.exception("fault %s: the solver failed; starting a new one with what had been accepted", reference)
        return reference

    def _replace_solver(self, reference: str) -> Iterator[Stepped]:
        """A new solver with what had been accepted, and the step that brought it there."""
        try:
            reported = self._rebuild()
            if reported is not None:
                self._next(reported)
                yield self._published(reported)._replace(rebuilt=True)
        except Exception:
            self._broken = reference
            log.exception("fault %s: what had been accepted could not be brought back; the map is broken", reference)

    def _go_back(self, report: Any) -> Iterator[Stepped]:
        """The last step, which gave `report`, does not count: what was there before it, in a new solver.

        That is a step of its own, whose delta has everything; the revision of the one that does not count was not used.
        """
        started = time.perf_counter()
        try:
            solver, own = undone(self._solver, report, *self._accepted_counts)
        except Exception:
            self._broken = secrets.token_hex(4)
            log.exception("fault %s: a step could not be undone; the map is broken", self._broken)
            return
        self._solver = solver
        if not any(self._accepted_counts):
            return
        reported = own.as_dict() | {
            "strategy": "full", "because": "a step that diverged was undone", "new_variables": 0, "new_factors": 0,
            "solver_ms": (time.perf_counter() - started) * 1e3,
        }  # fmt: skip
        self._next(reported)
        yield self._published(reported)

    def _rebuild(self) -> dict[str, Any] | None:
        """What had been accepted are the first variables and factors: whatever a failed insert left is behind them."""
        variables, _ = self._solver.graph(*self._accepted_counts)
        for group in variables:
            if not np.isfinite(group.values).all():
                raise ValueError(f"the failed solver's values of {group.kind} are not finite")
        fresh, started = self._make(), time.perf_counter()
        report = fresh.renew(self._solver, *self._accepted_counts)
        found = fresh.variable_count, fresh.factor_count
        if found != self._accepted_counts:
            accepted = self._accepted_counts
            raise ValueError(f"the failed solver holds {found} variables and factors; accepted were {accepted}")
        self._solver = fresh
        if not any(self._accepted_counts):
            return None
        return report.as_dict() | {"solver_ms": (time.perf_counter() - started) * 1e3}


def _kept_of(reported: Mapping[str, Any]) -> dict[str, Any]:
    """What else is kept of a step, for its map's history."""
    counts = {name: int(reported.get(name, 0)) for name in ("changed", "eliminated")}
    return {"step_ms": float(reported.get("step_ms", 0.0)), **counts}


def _has_converged(reported: Mapping[str, Any]) -> bool:
    return bool(reported.get("converged", True))
