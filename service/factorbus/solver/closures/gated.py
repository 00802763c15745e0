"""A solver whose closures are tested as they come.

    1  what a batch has besides closures goes in, one step
    2  its closures, and a few suspects, are judged together (`choosing`); those that are believed go in, one step
    3  of the closures that are in, the worst is judged against all others; an improbable one goes out, one step
    4  where suspects agree that the map calls improbable, one place's closures are taken out on trial: they stay out
       if more places' closures are believed then

All of it follows from what was inserted: the same batches give the same verdicts, and the same bits.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.closures.choosing import AGREES, PASSED, UNSURE, Chosen, choose_closures, closure_places
from factorbus.solver.closures.evidence import ClosureNumbers, judge_accepted
from factorbus.solver.closures.ledger import (
    ACCEPTED,
    POSES_BETWEEN,
    REJECTED,
    RESTORED,
    SUSPECT,
    Closure,
    Ledger,
    UnknownClosure,
)
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.closures.motions import inverse_motion, motions_of_poses, tangent_of
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.groups import Addition, BatchLike
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.options import Options
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver

CONTRADICTED, BY_USER = "contradicted", "user"
_NEWEST = 40  # suspects, or accepted ones, among which places are looked for
_BELIEVED = {PASSED, AGREES}
_EXPECTED = 3.0  # rᵀ Ω r of one accepted closure that is worth a look, for each of its numbers
_WORST = 4  # accepted ones whose d² is computed in a step
_RETRY = 2  # rivals that have to be new before the same closures are tried again


@dataclass(frozen=True, slots=True)
class GatedReport:
    """What one insert did: the report of its last step, and the closures whose state it changed.

    accepted: new ones, and suspects of before.  suspects: new ones.  contradicted: they were in, and are suspects.
    """

    step: StepReport
    accepted: tuple[Closure, ...] = ()
    suspects: tuple[Closure, ...] = ()
    contradicted: tuple[Closure, ...] = ()


class GatedSolver:
    """A `Solver`, in `solver`, that takes in no closure that it does not believe.  Not thread-safe."""

    def __init__(self, options: Options | None = None, policy: ClosurePolicy | None = None) -> None:
        self.solver, self.policy = Solver(options), policy or ClosurePolicy()
        self.closures: list[Closure] = []
        self._ledgers = {kind: Ledger(kind) for kind in POSES_BETWEEN}
        self._joined = TrustedForest()
        self._steps, self._moved_at, self._retested = 0, 0, 0
        self._low, self._high = np.full(2, np.inf), np.full(2, -np.inf)  # of all places that closures were between
        self._tried: dict[int, int] = {}  # of a closure that was taken out on trial: the newest rival then
        self._before: dict[int, bool] = {}  # of a closure whose state changed in this insert: whether it was in

    def insert(self, batch: BatchLike) -> GatedReport:
        """Take in `batch`, but for closures that are not believed.

        Raises what `Solver.stage` and `step` do; nothing has changed then.
        """
        trusted, closing = self._joined.split(batch)
        try:
            if closing:
                self._check(batch)
            self.solver.stage(Addition(batch.variables, trusted))
            report = self.solver.step()
        except SolverError:
            self._joined.forget()
            raise
        self._before = {}
        self._steps += 1
        first = len(self.closures)
        for factor in closing:
            ledger, graph = self._ledgers[factor.kind], self.solver._graph
            ends = np.array([graph.find(key) for key in factor.keys[0].tolist()])
            self.closures.append(ledger.add(factor, len(self.closures), ends, self._steps))
        for ledger in self._ledgers.values():
            new = [c.row for c in self.closures[first:] if c.factor.kind == ledger.kind]
            if new:
                report = self._judge(ledger, np.array(new)) or report
                report = self._retest(ledger) or report
        return self._report(report, first)

    def _check(self, batch: BatchLike) -> None:
        """Closures of a batch are checked with all the rest, before any of it goes in."""
        graph = self.solver._graph
        mark = graph.mark()
        admit(graph, batch)
        graph.forget(mark)

    def suspects(self) -> list[Closure]:
        """Closures that the estimate does not have, and that may still be believed."""
        return [c for c in self.closures if c.state == SUSPECT]

    def accept(self, number: int) -> StepReport | None:
        """Take a closure in, for good.  None: it is in already.  Raises UnknownClosure, and what `step` does."""
        closure = self._named(number)
        report = None if closure.is_in else self._put_in([closure])
        self._move(closure, RESTORED, BY_USER)
        return report

    def reject(self, number: int) -> StepReport | None:
        """Take a closure out, for good.  None: it was out already.  Raises UnknownClosure."""
        closure = self._named(number)
        self._move(closure, REJECTED, BY_USER)
        return self._take_out([closure]) if closure.is_in else None

    def _named(self, number: int) -> Closure:
        if not 0 <= number < len(self.closures):
            raise UnknownClosure(number, len(self.closures))
        return self.closures[number]

    def _move(self, closure: Closure, state: str, reason: str) -> None:
        self._before.setdefault(closure.number, closure.is_in)
        self._ledgers[closure.factor.kind].move(closure, state, reason, self._steps)

    def _report(self, step: StepReport, first: int) -> GatedReport:
        moved = [(self.closures[k], was_in) for k, was_in in sorted(self._before.items())]
        return GatedReport(
            step,
            tuple(c for c, was_in in moved if c.is_in and not was_in),
            tuple(c for c in self.closures[first:] if not c.is_in),
            tuple(c for c, was_in in moved if was_in and not c.is_in),
        )

    # 2 ----------------------------------------------------------------------------------------------------------------

    def _judge(self, ledger: Ledger, new: I64) -> StepReport | None:
        """Judge new closures and some suspects; None: nothing changed."""
        looked_at = np.union1d(self._revisited(ledger, np.setdiff1d(ledger.suspects(), new)), new)
        chosen = self._chosen(ledger, looked_at)
        believed = self._believed(ledger, looked_at, chosen)
        if believed:
            return self._put_in_or_keep(believed)
        return self._try_rivals(ledger, looked_at[chosen.rivals]) if chosen.rivals else None

    def _believed(self, ledger: Ledger, looked_at: I64, chosen: Chosen) -> list[Closure]:
        """Write down what was chosen; gives those that are believed."""
        closures = [ledger.closures[row] for row in looked_at.tolist()]
        for c, reason, d2, p in zip(closures, chosen.reasons, chosen.distance, chosen.chance, strict=True):
            c.reason, c.distance, c.chance, c.looked = reason, float(d2), float(p), self._steps
        ledger.looked[looked_at] = self._steps
        believed = [c for c in closures if c.reason in _BELIEVED]
        for c in believed:
            self._move(c, ACCEPTED, c.reason)
        return believed

    def _chosen(self, ledger: Ledger, rows: I64) -> Chosen:
        numbers = self._numbers(ledger, rows)
        for T in (numbers.a, numbers.b):
            self._low, self._high = (
                np.minimum(self._low, T[:, :2, -1].min(0)),
                np.maximum(self._high, T[:, :2, -1].max(0)),
            )
        return choose_closures(numbers, float((self._high - self._low).max()) / 2.0, self.policy)

    def _revisited(self, ledger: Ledger, suspects: I64) -> I64:
        """Suspects to look at again: of the newest that are unsure those of many places, the newest that are not, and,
        if the map has got or lost closures since, those that were not looked at for longest."""
        most, among = self.policy.closure_revisits, suspects[-4 * _NEWEST :]
        is_unsure = np.array([ledger.closures[row].reason == UNSURE for row in among.tolist()], bool)
        unsure = among[is_unsure][-_NEWEST:][::-1]
        if unsure.size:
            places = closure_places(self._numbers(ledger, unsure, False), self.policy.closure_place_m)
            before = [int((places[:k] == places[k]).sum()) for k in range(unsure.size)]  # newer ones of the same place
            unsure = unsure[np.argsort(before, kind="stable")][: most // 2]
        picked = np.concatenate([unsure, among[~is_unsure][::-1][: most // 4]])
        left = np.setdiff1d(suspects, picked)
        left = left[ledger.looked[left] < self._moved_at]
        longest = left[np.argsort(ledger.looked[left], kind="stable")]
        return np.concatenate([picked, longest[: most - picked.size]])

    def _numbers(self, ledger: Ledger, rows: I64, with_covariance: bool = True) -> ClosureNumbers:
        ends, graph = ledger.ends[rows], self.solver._graph
        different, where = np.unique(ends, return_inverse=True)
        where = where.reshape(ends.shape)
        T = motions_of_poses(graph.values[graph.var[different, at.V_AT, None] + np.arange(ledger.size)])
        known = np.empty((0, 0))
        if with_covariance:
            source, d = self.solver.covariances, ledger.dim
            joint = CovarianceBlocks(source.try_view() or source.factored()).joint(different)
            scalars = (where.reshape(-1, 1) * d + np.arange(d)).reshape(-1)
            known = joint[np.ix_(scalars, scalars)]
        return ClosureNumbers(T[where[:, 0]], T[where[:, 1]], ledger.z[rows], ledger.noise[rows], known)

    # 3 ----------------------------------------------------------------------------------------------------------------

    def _retest(self, ledger: Ledger) -> StepReport | None:
        """Take out the worst of those accepted, if it is improbable; None: none is."""
        tested, most = ledger.tested(), self.policy.closure_retests
        if tested.size > most:
            tested = tested[(self._retested + np.arange(most)) % tested.size]
            self._retested += most
        if not tested.size:
            return None
        now = self._numbers(ledger, tested, False)
        r = tangent_of(inverse_motion(now.z) @ inverse_motion(now.a) @ now.b)
        own = np.einsum("na,nab,nb->n", r, ledger.weight[tested], r)
        worst = tested[np.argsort(-own, kind="stable")[:_WORST]]
        if float(own.max()) <= _EXPECTED * ledger.dim:
            return None
        d2 = judge_accepted(self._numbers(ledger, worst))
        found = ledger.closures[int(worst[int(d2.argmax())])]
        if float(d2.max()) <= float(threshold(np.array([ledger.dim]), self.policy.closure_out_probability)[0]):
            return None
        found.distance = float(d2.max())
        self._move(found, SUSPECT, CONTRADICTED)
        return self._take_out([found])

    # 4 ----------------------------------------------------------------------------------------------------------------

    def _try_rivals(self, ledger: Ledger, rivals: I64) -> StepReport | None:
        """Take closures of one place out; where more places' rivals are believed then, those go in instead."""
        tested = ledger.tested()[-_NEWEST:]
        newest = int(np.sort(rivals)[-_RETRY])
        tested = tested[[self._tried.get(ledger.closures[row].number, -1) < newest for row in tested.tolist()]]
        if not tested.size:
            return None
        least_sure = int(np.argmax([ledger.closures[row].chance for row in tested.tolist()]))
        now, within = self._numbers(ledger, tested, False), self.policy.closure_place_m
        near = [np.linalg.norm(T[:, :-1, -1] - T[least_sure, :-1, -1], axis=1) <= within for T in (now.a, now.b)]
        on_trial = [ledger.closures[row] for row in tested[near[0] & near[1]].tolist()]
        for c in on_trial:
            self._tried[c.number] = int(rivals.max())
        report = self._take_out(on_trial)
        chosen = self._chosen(ledger, rivals)
        believed = np.array([reason in _BELIEVED for reason in chosen.reasons])
        numbers = self._numbers(ledger, rivals[believed], False)
        if not believed.any() or np.unique(closure_places(numbers, within)).size < 2:
            return self._put_in_or_keep(on_trial) or report
        for c in on_trial:
            self._move(c, SUSPECT, CONTRADICTED)
        return self._put_in_or_keep(self._believed(ledger, rivals, chosen)) or report

    # ------------------------------------------------------------------------------------------------------------------

    def _put_in_or_keep(self, closures: Sequence[Closure]) -> StepReport | None:
        """Put them in; where the step fails they are suspects, for that reason."""
        try:
            return self._put_in(closures)
        except SolverError as problem:
            for c in closures:
                self._move(c, SUSPECT, problem.code)
            return None

    def _put_in(self, closures: Sequence[Closure]) -> StepReport:
        first = self.solver.stage(Addition((), [c.factor for c in closures]))
        report = self.solver.step()
        for k, c in enumerate(closures):
            c.factor_id = first + k
        self._moved_at = self._steps
        return report

    def _take_out(self, closures: Sequence[Closure]) -> StepReport:
        changes = [_Removed(np.array([c.factor_id for c in closures]))]
        for c in closures:
            c.factor_id = -1
        self._moved_at = self._steps
        came = try_change(self.solver, changes)
        if came is not None:
            return came[1]
        self.solver, _, report, _ = with_changes(self.solver, changes)
        return report


@dataclass(frozen=True, slots=True)
class _Removed:
    """Factors that go, as a `ChangeLike`."""

    factors: I64 | None
    change: str = "remove_factors"
    keys: I64 | None = None
    loss: str = ""
    scale: F64 | None = None
    weight: F64 | None = None
    alone: bool = False
    kind: str = ""
    values: F64 | None = None
    carry: bool = False
