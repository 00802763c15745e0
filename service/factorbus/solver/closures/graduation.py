"""Closures that are weighed by graduated non-convexity, in the steps of a map: which are, from where, how far they are.

    1  a new closure goes in with its final loss, in the step of its batch.  Most fit, and nothing follows
    2  one that does not fit is held against the map with the joint covariance of its ends.  d² is what χ² of all the
       rest rises by if the map gives way to it, to first order: within the gate that is less than what its loss counts
       where the map does not, so it is graduated.  Beyond, the map does not follow it
    3  graduated: its kernel begins quadratic, and so do those of closures whose residuals that moves; a step each for
       μ = 0.12, 0.384, 0.9648 and 1 (`graduated_kernel`)
    4  one with less than a hundredth of its weight is outweighed, and is no factor of the map until it is graduated
    5  closures that are outweighed may be right and the map wrong.  Where three or more agree around their loops they
       are graduated together on a copy, and that is done in the map if its χ², with all losses final, is lower then
    6  outweighed ones whose residual has changed are looked at again with the next closure

Deciding is here; the caller has the solver, makes the steps, and says whether they went well.
"""

from collections.abc import Callable, Generator, Iterator, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from factorbus.solver.changes.requested import ChangeLike
from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.closures.choosing import LEAST_RIVALS, limits_of
from factorbus.solver.closures.evidence import FalseSpread, judge_each, judge_pairs
from factorbus.solver.closures.graduated_kernel import (
    CONTROL_PARAMETERS,
    GRADUATED_LOSS,
    chi2_of_weights,
    final_weights,
    scales_at,
    with_scale,
)
from factorbus.solver.closures.ledger import (
    ACCEPTED,
    FAILED,
    OUTWEIGHED,
    SUSPECT,
    Closure,
    ClosureLedger,
    ClosureVerdicts,
    Ledger,
    verdicts_of,
)
from factorbus.solver.closures.motions import inverse_motion, tangent_of
from factorbus.solver.closures.numbers import closure_numbers
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.closures.switching import planned_switch
from factorbus.solver.divergence import copied
from factorbus.solver.errors import SolverError
from factorbus.solver.graph.groups import Addition
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.report import StepReport
from factorbus.solver.solver import Solver

FITS, GRADUATING, GRADUATED, LIGHT = "fits", "graduating", "graduated", "light"
_LEAST_WEIGHT = 0.01  # of a closure that is in the map
_MOVED = 0.1  # of c² + s: by more s has changed
_COMPARED = 32  # suspects that are looked at again, or may agree with new ones
_SAME_SCALE = 1e-3  # of k: a loss that changes by less stays
_LOOK_BACK_EVERY = 8  # looks
_UNTRIED = 2  # of those that agree, that were in no trial


class GraduationStage(NamedTuple):
    """What some closures are from now on; scale (n,): of the losses that they get, in a step; None: they keep them."""

    verdicts: ClosureVerdicts
    scale: F64 | None


_Scales: TypeAlias = tuple[I64, F64]  # rows of a ledger, and the scales of their losses
_Stages: TypeAlias = Generator[GraduationStage, bool, bool]  # gives whether all of them were made


class ClosureGraduation:
    """Weighs the closures of a map.  c2, gate: c² of the final loss, and of d², by numbers of a residual."""

    def __init__(self, policy: ClosurePolicy | None = None) -> None:
        policy = policy or ClosurePolicy()
        limits = {kind: limits_of(policy, d) for kind, d in (("between_se2", 3), ("between_se3", 6))}
        self.c2: dict[str, float] = {kind: out for kind, (_, out, _) in limits.items()}
        self.gate: dict[str, float] = {kind: gate for kind, (gate, _, _) in limits.items()}
        self._spreads: dict[str, FalseSpread] = {kind: spread for kind, (_, _, spread) in limits.items()}

    @property
    def final_scales(self) -> dict[str, float]:
        """c by kind of factor."""
        return {kind: float(np.sqrt(c2)) for kind, c2 in self.c2.items()}

    def looks(
        self, solver: Callable[[], Solver], ledgers: ClosureLedger, new: Sequence[Closure]
    ) -> Generator[GraduationStage, bool, None]:
        """What follows an insert with `new`, each stage once that before is applied; sent: whether it was.

        Raises SolverError.
        """
        for kind in dict.fromkeys(c.factor.kind for c in new):
            look = _Look(solver, ledgers, kind, self)
            yield from look.stages()


class _Look:
    """At the closures of one kind."""

    def __init__(
        self, solver: Callable[[], Solver], ledgers: ClosureLedger, kind: str, settings: ClosureGraduation
    ) -> None:
        self._solver, self._ledgers, self._ledger = solver, ledgers, ledgers.of_kind[kind]
        self._c2, self._gate, self._spread = settings.c2[kind], settings.gate[kind], settings._spreads[kind]
        self._looks_back = ledgers.looks % _LOOK_BACK_EVERY == 0
        self._distance: dict[int, float] = {}  # d² by row, as found here
        self._why: dict[int, str] = {}
        self._tried: dict[int, int] = {}

    def stages(self) -> Generator[GraduationStage, bool, None]:
        """All that follows."""
        ledger = self._ledger
        new = ledger.unjudged()
        chi2 = own_chi2(self._solver(), ledger, new)
        far = new[chi2 > self._c2]
        looked_at = np.concatenate([self._changed(), far])
        if looked_at.size:
            distance = judge_each(closure_numbers(self._solver(), ledger, looked_at), [self._spread]).distance
            self._distance.update(zip(looked_at.tolist(), distance.tolist(), strict=True))
            fits = own_chi2(self._solver(), ledger, looked_at) <= self._c2
            plausible = looked_at[(distance <= self._gate) | fits]
            done = True
            if plausible.size:
                done = yield from self._carry_out(self._graduate(self._solver, plausible))
            if done and far.size:
                yield from self._try_agreeing(far)
        elif not self._looks_back:
            yield GraduationStage(self._verdicts(new, chi2, np.ones(new.size, bool)), None)
            return
        rows = self._weighed()
        chi2 = own_chi2(self._solver(), ledger, rows)
        verdicts = self._verdicts(rows, chi2, np.isin(rows, looked_at) | ledger.is_new[rows])
        if verdicts.states:
            yield GraduationStage(verdicts, None)

    def _weighed(self) -> I64:
        """Rows of those that the policy weighs: users have the last word on the others."""
        n = self._ledger.count
        return np.flatnonzero(self._ledger.is_tested[:n] | self._ledger.is_suspect[:n])

    def _suspects(self) -> I64:
        """Rows of those of before."""
        n = self._ledger.count
        return np.flatnonzero(self._ledger.is_suspect[:n] & ~self._ledger.is_new[:n])

    def _changed(self) -> I64:
        """Those of them whose residual has changed, or whose step failed: of many those that fit best."""
        rows, closures = self._suspects(), self._ledger.closures
        if not rows.size:
            return rows
        before = chi2_of_weights(np.array([closures[row].chance for row in rows.tolist()]), self._c2)
        failed = np.array([closures[row].reason == FAILED for row in rows.tolist()])
        chi2 = own_chi2(self._solver(), self._ledger, rows)
        due = np.flatnonzero(self._has_moved(before, chi2) | failed | (chi2 <= self._c2))
        return rows[np.sort(due[np.argsort(chi2[due], kind="stable")[:_COMPARED]])]

    def _has_moved(self, before: F64, chi2: F64) -> np.ndarray:
        return np.asarray(~(np.abs(chi2 - before) <= _MOVED * (self._c2 + before)))

    def _graduate(self, solver: Callable[[], Solver], rows: I64) -> Iterator[_Scales]:
        """The scales of `rows`, and of others that they move, from quadratic to final."""
        ledger, c2 = self._ledger, self._c2
        others = np.flatnonzero(ledger.is_tested[: ledger.count])
        others = others[~np.isin(others, rows)]
        before = own_chi2(solver(), ledger, others)
        yield rows, scales_at(own_chi2(solver(), ledger, rows), 0.0, c2)
        moved = self._has_moved(before, own_chi2(solver(), ledger, others))
        if moved.any():
            rows = np.concatenate([others[moved], rows])
            yield rows, scales_at(own_chi2(solver(), ledger, rows), 0.0, c2)
        for mu in CONTROL_PARAMETERS[1:]:
            yield rows, scales_at(own_chi2(solver(), ledger, rows), mu, c2)

    def _carry_out(self, scales: Iterator[_Scales]) -> _Stages:
        """One stage after the other; where one fails all have the final scale again, and are suspects meanwhile.

        Raises what measuring between stages does, after they have it again.
        """
        scale_of = dict[int, float]()
        try:
            for rows, scale in scales:
                before = dict(scale_of)
                stage = self._stage(rows, scale, scale_of)
                self._why.update(dict.fromkeys(rows.tolist(), GRADUATED))
                if stage is not None and not (yield stage):
                    yield from self._go_back(before)
                    self._why.update(dict.fromkeys(rows.tolist(), FAILED))
                    return False
        except Exception:
            yield from self._go_back(scale_of)
            raise
        return True

    def _go_back(self, scale_of: dict[int, float]) -> Generator[GraduationStage, bool, None]:
        """Those whose loss is not the final one have it again, as suspects that wait for another try."""
        rows, final = np.array(list(scale_of), np.int64), float(np.sqrt(self._c2))
        stage = self._stage(rows, np.full(rows.size, final), scale_of)
        if stage is not None:
            v = stage.verdicts
            count = v.factors.size
            yield stage._replace(verdicts=v._replace(states=(SUSPECT,) * count, reasons=(FAILED,) * count))

    def _stage(self, rows: I64, scale: F64, scale_of: dict[int, float]) -> GraduationStage | None:
        """Of those whose scale is another than in `scale_of`, or than the final one, as it is noted there."""
        final = float(np.sqrt(self._c2))
        before = np.array([scale_of.get(row, final) for row in rows.tolist()])
        differs = np.abs(scale - before) > np.where(scale == final, 0.0, _SAME_SCALE) * before
        if not differs.any():
            return None
        rows, scale = rows[differs], scale[differs]
        scale_of.update(zip(rows.tolist(), scale.tolist(), strict=True))
        on_the_way = any(k != final for k in scale_of.values())
        told = list[tuple[Closure, str, str, float, float, int]]()
        for c in (self._ledger.closures[row] for row in rows.tolist()):
            reason = GRADUATING if on_the_way else GRADUATED if c.reason == GRADUATING else c.reason
            told.append((c, c.state, reason, c.distance, c.chance, c.tried))
        return GraduationStage(verdicts_of(told), scale)

    def _try_agreeing(self, far: I64) -> _Stages:
        """New ones that are outweighed, with others that agree with them, if all of χ² is lower with them in."""
        ledger, solver = self._ledger, self._solver()
        group = self._agreeing(far)
        closures = [ledger.closures[row] for row in group.tolist()]
        untried = sum(c.tried < 0 for c in closures)
        if group.size < LEAST_RIVALS or untried < _UNTRIED:
            return True
        self._tried.update(dict.fromkeys(group.tolist(), max(c.factor_id for c in closures)))
        stages, scale_of = list[_Scales](), dict[int, float]()
        own = own_chi2(solver, ledger, group)[[not c.is_in for c in closures]]
        held, chi2 = [copied(solver)], solver.chi2() + float((self._c2 * own / (self._c2 + own)).sum())
        try:
            for scales in self._graduate(lambda: held[0], group):
                stages.append(scales)
                if (stage := self._stage(*scales, scale_of)) is not None:
                    held[0] = step_with(held[0], self._ledgers, stage).solver
        except SolverError:
            return True
        if not held[0].chi2() < chi2:
            return True
        return (yield from self._carry_out(iter(stages)))

    def _agreeing(self, far: I64) -> I64:
        """The newest of `far` that is still outweighed, and all that agree with it; none where it is not."""
        ledger = self._ledger
        out = far[own_chi2(self._solver(), ledger, far) > self._c2]
        others = np.concatenate([self._suspects()[-_COMPARED:], out[:-1]])
        if not out.size or not others.size:
            return out[:0]
        rows = np.append(others, out[-1:])
        numbers, i = closure_numbers(self._solver(), ledger, rows), np.full(others.size, others.size)
        agree = judge_pairs(numbers, i, np.arange(others.size), [self._spread]).distance <= self._gate
        return np.append(others[agree], out[-1:])

    def _verdicts(self, rows: I64, chi2: F64, looked_at: np.ndarray) -> ClosureVerdicts:
        """Of those that were looked at, graduated or tried, and of others whose state is another."""
        told = []
        noted = np.array([*self._why, *self._tried], np.int64)
        other = (chi2 <= self._c2) != self._ledger.is_tested[rows]
        chosen = looked_at | other | np.isin(rows, noted)
        rows, chi2, looked_at = rows[chosen], chi2[chosen], looked_at[chosen]
        weights = final_weights(chi2, self._c2)
        for row, s, weight, looked in zip(rows.tolist(), chi2.tolist(), weights.tolist(), looked_at, strict=True):
            c, why, tried = self._ledger.closures[row], self._why.get(row, ""), self._tried.get(row)
            state = ACCEPTED if s <= self._c2 and why != FAILED and c.is_in else SUSPECT
            if not (looked or why or tried is not None or state != c.state):
                continue
            reason = why or (c.reason if c.reason == GRADUATED else FITS)
            if state == SUSPECT and why != FAILED:
                reason = OUTWEIGHED if weight < _LEAST_WEIGHT or not c.is_in else LIGHT
            distance = self._distance.get(row, c.distance)
            told.append((c, state, reason, distance, weight, c.tried if tried is None else tried))
        return verdicts_of(told)


class SteppedWith(NamedTuple):
    """The solver after a stage, which may be another one, and the report of its step."""

    solver: Solver
    report: StepReport


class LossChanged(NamedTuple):
    """Factors that get another loss, as a `ChangeLike`."""

    factors: I64 | None
    scale: F64 | None
    loss: str = GRADUATED_LOSS
    change: str = "loss"
    keys: I64 | None = None
    weight: F64 | None = None
    alone: bool = False
    kind: str = ""
    values: F64 | None = None
    carry: bool = False


def own_chi2(solver: Solver, ledger: Ledger, rows: I64) -> F64:
    """s = rᵀ Ω r (n,) of closures at the estimate."""
    if not rows.size:
        return np.empty(0)
    now = closure_numbers(solver, ledger, rows, False)
    r = tangent_of(inverse_motion(now.z) @ inverse_motion(now.a) @ now.b)
    return np.einsum("na,na->n", r, np.linalg.solve(now.noise, r[..., None])[..., 0])


def step_with(solver: Solver, ledgers: ClosureLedger, stage: GraduationStage) -> SteppedWith:
    """Make the step of a stage with scales, or that takes out what is outweighed.  Raises SolverError."""
    ids, following = stage.verdicts.factors, solver.factor_graph.next_id
    if stage.scale is None:
        return _changed(solver, planned_switch(ledgers, stage.verdicts).removals, Addition((), ()))
    inside = solver.factor_graph.rows_of(ids) >= 0
    changes = [LossChanged(ids[inside], stage.scale[inside])] if inside.any() else []
    closures = zip(ledgers.named(ids[~inside].tolist()), stage.scale[~inside].tolist(), strict=True)
    batch = Addition((), [with_scale(c.factor, scale) for c, scale in closures])
    if changes:
        done = _changed(solver, changes, batch)
    else:
        solver.stage(batch)
        done = SteppedWith(solver, solver.step())
    if not inside.all():
        done.solver.factor_graph.rename_last(ids[~inside], following)
    return done


def _changed(solver: Solver, changes: Sequence[ChangeLike], batch: Addition) -> SteppedWith:
    if (came := try_change(solver, changes, batch)) is not None:
        return SteppedWith(solver, came[1])
    other, _, report, _ = with_changes(solver, changes, batch)
    return SteppedWith(other, report)
