"""What closures are, judged by the estimate: nothing is changed here.

    look        new ones and a few suspects are judged together (`choosing`); those that are believed are to go in
    look_back   of the closures that are in, the worst is judged against all others; an improbable one is to go out

What cannot have changed is not computed anew: `Ledger.bound` says of one that is in, or that is improbable, what its d²
is at most, or at least, while the map only gets factors.

Where suspects agree that the map calls improbable, one place's closures are taken out of a copy of the solver, on
trial: they are to stay out if more places' closures are believed then.

All of it follows from the estimate and the ledger: the same ones give the same verdicts.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import TypeAlias

import numpy as np

from factorbus.solver.closures.choosing import (
    AGREES,
    IMPROBABLE,
    LEAST_RIVALS,
    PASSED,
    Chosen,
    ClosureOdds,
    choose_closures,
    closure_places,
    limits_of,
)
from factorbus.solver.closures.evidence import (
    ClosureNumbers,
    exact_weights_without,
    numbers_without,
    odds_of_weights,
    odds_without,
    volume_of,
    weights_without,
)
from factorbus.solver.closures.expected import ExpectedClosures
from factorbus.solver.closures.ledger import (
    ACCEPTED,
    SUSPECT,
    Closure,
    ClosureLedger,
    ClosureVerdicts,
    Ledger,
    verdicts_of,
)
from factorbus.solver.closures.numbers import closure_numbers, residuals_weighed
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.closures.switching import without_factors
from factorbus.solver.covariance.kernels.looked_back import WORST
from factorbus.solver.errors import SolverError
from factorbus.solver.kernels.closures.ahead import list_companions
from factorbus.solver.kernels.closures.back import count_in_spread, is_any_due, longest_side
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.solver import Solver

CONTRADICTED = "contradicted"
_NEWEST = 40  # suspects, or accepted ones, among which places are looked for
COMPARED = 4 * _NEWEST  # of the newest suspects, with which new closures may agree
_BELIEVED = {PASSED, AGREES}
_PLANE_DIM, _SPACE_DIM = 3, 6
_MOST_COUNTED = 256  # improbable ones
_TOGETHER = 64  # new closures that are judged together: each two of them are compared
_LOOK_BACK_EVERY = 8  # looks
_RETRY = 2  # rivals that have to be new before the same closures are tried again

_Row: TypeAlias = tuple[Closure, str, str, float, float, int]


class ClosureJudge:
    """Judges the closures of a map."""

    def __init__(self, policy: ClosurePolicy | None = None) -> None:
        self.policy = policy or ClosurePolicy()
        self.limits = {dims: limits_of(self.policy, dims) for dims in (_PLANE_DIM, _SPACE_DIM)}
        gate, out, spread = self.limits[_PLANE_DIM]
        self._ahead = np.array([gate, out, 1.0, volume_of(spread)])

    def limits_ahead(self, solver: Solver, ledger: Ledger) -> F64:
        """As `believe_ahead` takes them, the same array each time."""
        share = self._share_near(solver, ledger) if ledger.improbable else 1.0
        self._ahead[2] = self.policy.closure_chance_max / ledger.odds_false(share)
        return self._ahead

    def is_settled(self, solver: Solver, ledgers: ClosureLedger, new: Sequence[Closure]) -> bool:
        """Whether `looks` has nothing to say behind an insert whose closures all went in with its step."""
        if ledgers.looks % _LOOK_BACK_EVERY == 0:
            return False
        if not ledgers.suspect_count:
            return True
        return isinstance(new, ExpectedClosures) and not self._is_any_due(solver, ledgers, ledgers.of_kind[new.KIND])

    def looks(
        self, solver: Callable[[], Solver], ledgers: ClosureLedger, new: Sequence[Closure]
    ) -> Iterator[ClosureVerdicts]:
        """What it says behind an insert with `new`, each once that before is applied.  Raises SolverError.

        Where the map expected all of them, what it has is seldom contradicted: that is looked at now and then.
        """
        is_expected = isinstance(new, ExpectedClosures)
        looks_back = ledgers.looks % _LOOK_BACK_EVERY == 0 or not (is_expected or all(c.is_in for c in new))
        for kind in (new.KIND,) if is_expected else dict.fromkeys(c.factor.kind for c in new):
            while (verdicts := self.look(solver(), ledgers, kind)) is not None:
                yield verdicts
            if looks_back and (verdicts := self.look_back(solver(), ledgers, kind)) is not None:
                yield verdicts

    def look(self, solver: Solver, ledgers: ClosureLedger, kind: str) -> ClosureVerdicts | None:
        """Judge new ones of a kind, the oldest where there are many, and after a look that moved any, or with new ones,
        suspects that may be believed now; None: there are none.  Raises SolverError.
        """
        ledger = ledgers.of_kind[kind]
        if not ledgers.suspect_count or not self._is_any_due(solver, ledgers, ledger):
            return None
        new = ledger.unjudged()[:_TOGETHER]
        if not (new.size or ledgers.looks == ledgers.moved_at) or not ledger.is_suspect[: ledger.count].any():
            return None
        looked_at, settled = self._revisited(solver, ledgers, ledger, new)
        alone = self._improbable(solver, ledger, settled)
        if not looked_at.size:
            return verdicts_of(alone) if alone else None
        chosen = self._chosen(solver, ledger, looked_at)
        ledger.bound[looked_at] = np.linalg.inv(chosen.allowed)
        rows = _rows(ledger, looked_at, chosen)
        if chosen.rivals and not _believes(chosen):
            tried = self._try_rivals(solver, ledger, looked_at[chosen.rivals])
            again = {row[0].factor_id for row in tried}
            rows = [row for row in rows if row[0].factor_id not in again] + tried
        return verdicts_of(rows + alone)

    def _is_any_due(self, solver: Solver, ledgers: ClosureLedger, ledger: Ledger) -> bool:
        """Whether any suspect is new, or may be believed now that others went in or out; of those in space it may be.

        One by itself is believed within the gate alone, and outside by its bound it stays what it is; what agrees with
        others may be beyond the gate.
        """
        if ledger.dim != _PLANE_DIM:
            return True
        moved_at = ledgers.moved_at if ledgers.looks == ledgers.moved_at else -1
        gate, out, _ = self.limits[_PLANE_DIM]
        return is_any_due(
            (ledger.is_suspect, ledger.is_new, ledger.is_improbable),
            ledger.looked,
            (ledger.count, moved_at),
            ledger.ends,
            (ledger.z, ledger.bound),
            solver._graph.array_table,
            (gate if ledgers.suspect_count == 1 else out, out),
        )

    def look_back(self, solver: Solver, ledgers: ClosureLedger, kind: str) -> ClosureVerdicts | None:
        """The worst of those accepted, where it is improbable; None: none is.  Raises SolverError."""
        ledger = ledgers.of_kind[kind]
        if not ledger.accepted:
            return None
        out, looked_at = self.limits[ledger.dim].out, (ledger.count, self.policy.closure_retests, ledgers.looks)
        if (worst := _contradicted(solver, ledger, looked_at, out)) < 0:
            return None
        row = np.array([worst])
        ledger.bound[row] = exact_weights_without(closure_numbers(solver, ledger, row))
        if (distance := residuals_weighed(solver, ledger, row).item()) <= out:
            return None
        found = ledger.closures[row.item()]
        return verdicts_of([(found, SUSPECT, CONTRADICTED, distance, found.chance, found.tried)])

    def _chosen(self, solver: Solver, ledger: Ledger, rows: I64, all_together: bool = False) -> Chosen:
        """Among rows."""
        extent = self._extent(solver, ledger) if rows.size > 1 else 0.0  # which one by itself does not need
        return choose_closures(
            closure_numbers(solver, ledger, rows), extent, self.policy, self._odds(solver, ledger), all_together
        )

    def _odds(self, solver: Solver, ledger: Ledger) -> ClosureOdds:
        """Those before, by the ledger and by where the newest improbable ones are.

        The odds of a residual are those of a false closure within the policy's spread: one that is farther off, and
        with which no others agree, says nothing of how many of these there are.
        """
        if not ledger.improbable or ledger.dim != _PLANE_DIM:
            return ledger.odds()
        return ledger.odds(self._share_near(solver, ledger))

    def _share_near(self, solver: Solver, ledger: Ledger) -> float:
        """Of the newest improbable ones in the plane, the share of those that are within the policy's spread."""
        among, table = (ledger.count, _MOST_COUNTED), solver._graph.array_table
        own = self.limits[_PLANE_DIM].spread
        spread = own.metres, own.radians
        near, count = count_in_spread(ledger.is_improbable, among, ledger.ends, ledger.z, table, spread)
        return near / count

    def _extent(self, solver: Solver, ledger: Ledger) -> float:
        """Half the length of the map: mistakes may lead to wherever it has poses."""
        kind = at.SE2 if ledger.dim == _PLANE_DIM else at.SE3
        return longest_side(solver._graph.array_table, kind) / 2.0

    def _revisited(self, solver: Solver, ledgers: ClosureLedger, ledger: Ledger, new: I64) -> tuple[I64, I64]:
        """What to look at, and new ones that are improbable, as too few agree with them for the map to be wrong.

        With new ones go, of the newest suspects that are unsure those of many places, and of those that are not, what
        agrees with a new one; and what may be believed now that the map has moved, first what was not looked at for
        longest.
        """
        most, out, settled, picked = self.policy.closure_revisits, self.limits[ledger.dim].out, new[:0], new
        count = ledger.count
        others = ledger.is_suspect[:count] & ~ledger.is_new[:count]
        if new.size:
            among = np.flatnonzero(others)[-COMPARED:]
            is_improbable = ledger.is_improbable[among]
            companions = self._companions(solver, ledger, new, np.ascontiguousarray(among[is_improbable][::-1]))
            if companions.size + new.size < LEAST_RIVALS:
                is_settled = residuals_weighed(solver, ledger, new) > out  # NaN where nothing was foreseen
                settled, picked = new[is_settled], new[~is_settled]
            if picked.size:
                unsure = among[~is_improbable][-_NEWEST:][::-1]
                picked = np.concatenate([picked, self._of_many_places(solver, ledger, unsure), companions[: most // 2]])
        others[picked] = False
        left = np.flatnonzero(others & (ledger.looked[: others.size] < ledgers.moved_at))
        if left.size:
            left = left[~(residuals_weighed(solver, ledger, left) > out)]
            longest = left[np.argsort(ledger.looked[left], kind="stable")]
            picked = np.concatenate([picked, longest[: max(most + new.size - picked.size, 0)]])
        return np.sort(picked), settled

    def _improbable(self, solver: Solver, ledger: Ledger, rows: I64) -> list[_Row]:
        """New ones that are improbable by their bounds."""
        if not rows.size:
            return []
        distance = residuals_weighed(solver, ledger, rows)
        chance = odds_of_weights(ledger.bound[rows], distance, self.limits[ledger.dim].spread)
        closures = [ledger.closures[row] for row in rows.tolist()]
        columns = zip(closures, distance.tolist(), chance.tolist(), strict=True)
        return [(c, SUSPECT, IMPROBABLE, d2, p, c.tried) for c, d2, p in columns]

    def _of_many_places(self, solver: Solver, ledger: Ledger, unsure: I64) -> I64:
        """Half as many as may be looked at again, those first of whose place few have come before."""
        most = self.policy.closure_revisits // 2
        if unsure.size <= most:
            return unsure
        places = _places(closure_numbers(solver, ledger, unsure, False), self.policy)
        before = [int((places[:k] == places[k]).sum()) for k in range(unsure.size)]
        return unsure[np.argsort(before, kind="stable")][:most]

    def _companions(self, solver: Solver, ledger: Ledger, new: I64, others: I64) -> I64:
        """Of `others`, in their order, those whose loop with a new one comes back within the policy's spread."""
        if not others.size or ledger.dim != _PLANE_DIM:
            return others
        found, spread = np.empty(others.size, np.int64), self.limits[ledger.dim].spread
        table = solver._graph.array_table
        count = list_companions(new, others, ledger.ends, ledger.z, table, spread.metres, spread.radians, found)
        return found[:count]

    def _try_rivals(self, solver: Solver, ledger: Ledger, rivals: I64) -> list[_Row]:
        """Without closures that are in: where the rivals are believed then, and are more likely right than these, they
        go in instead.

        Rivals of several places are held against the closures of one place, the least sure; those of one place against
        the least sure closure, if that is not sure by all others that are in.
        """
        newest = int(np.sort([ledger.closures[row].factor_id for row in rivals.tolist()])[-_RETRY])
        several = np.unique(_places(closure_numbers(solver, ledger, rivals, False), self.policy)).size > 1
        untried = np.array([row for row in ledger.tested().tolist() if ledger.closures[row].tried < newest], np.int64)
        find = self._least_sure_place if several else self._least_sure
        on_trial, odds, stay = find(solver, ledger, untried)
        if not on_trial:
            return stay
        last = max(ledger.closures[row].factor_id for row in rivals.tolist())
        stay += [(c, c.state, c.reason, c.distance, c.chance if several else odds, last) for c in on_trial]
        rows = np.concatenate([[c.row for c in on_trial], rivals])
        numbers = numbers_without(closure_numbers(solver, ledger, rows), len(on_trial))
        if not _believes(
            choose_closures(numbers, self._extent(solver, ledger), self.policy, self._odds(solver, ledger))
        ):
            return stay  # by the linear model, which takes no step
        try:
            without = without_factors(solver, [c.factor_id for c in on_trial])
        except SolverError:
            return stay  # the map does not stand without them
        chosen = self._chosen(without, ledger, rivals, True)
        believed = np.array([reason in _BELIEVED for reason in chosen.reasons])
        numbers = closure_numbers(without, ledger, rivals[believed], False)
        places = np.unique(_places(numbers, self.policy)).size if believed.any() else 0
        is_more_likely = places > 0 and chosen.chance[believed].min() <= self.policy.closure_chance_max * odds
        if not (places > 1 if several else is_more_likely):
            return stay
        out = [(c, SUSPECT, CONTRADICTED, c.distance, c.chance, last) for c in on_trial]
        gone = {c.factor_id for c in on_trial}
        return [row for row in stay if row[0].factor_id not in gone] + out + _rows(ledger, rivals, chosen)

    def _least_sure_place(
        self, solver: Solver, ledger: Ledger, untried: I64
    ) -> tuple[list[Closure], float, list[_Row]]:
        """Of the newest that are in, the closures of the place of the one that was least sure when it came."""
        tested = untried[-_NEWEST:]
        if not tested.size:
            return [], 1.0, []
        least_sure = int(np.argmax([ledger.closures[row].chance for row in tested.tolist()]))
        now, within = closure_numbers(solver, ledger, tested, False), self.policy.closure_place_m
        near = [np.linalg.norm(T[:, :-1, -1] - T[least_sure, :-1, -1], axis=1) <= within for T in (now.a, now.b)]
        return [ledger.closures[row] for row in tested[near[0] & near[1]].tolist()], 1.0, []

    def _least_sure(self, solver: Solver, ledger: Ledger, untried: I64) -> tuple[list[Closure], float, list[_Row]]:
        """The one that is least sure by all the others, and its odds; and the rest that may have been, with theirs.

        Of one that nothing else holds these are what they were when it came.
        """
        if ledger.dim != _PLANE_DIM:
            return [], 1.0, []
        least = self.policy.closure_sets_max
        chance = np.array([ledger.closures[row].chance for row in untried.tolist()])
        order = np.argsort(-chance, kind="stable")[: min(WORST, np.count_nonzero(chance > least))]
        unsure = untried[order]
        if not unsure.size:
            return [], 1.0, []
        odds = odds_without(closure_numbers(solver, ledger, unsure), self.limits[ledger.dim].spread)
        odds = np.where(np.isnan(odds), chance[order], odds)
        closures = [ledger.closures[row] for row in unsure.tolist()]
        worst = int(odds.argmax())
        on_trial = [closures[worst]] if odds[worst] > least else []
        rows = zip(closures, odds.tolist(), strict=True)
        return (
            on_trial,
            float(odds[worst]),
            [(c, c.state, c.reason, c.distance, p, c.tried) for c, p in rows if c not in on_trial],
        )


def _believes(chosen: Chosen) -> bool:
    """Whether any is believed."""
    return any(reason in _BELIEVED for reason in chosen.reasons)


def _places(numbers: ClosureNumbers, policy: ClosurePolicy) -> I64:
    return closure_places(numbers.a, numbers.b, policy.closure_place_m)


def _contradicted(solver: Solver, ledger: Ledger, looked_at: tuple[int, int, int], out: float) -> int:
    """The row of the worst of those whose d² is beyond `out` by their bounds, which are made anew; −1: none is.

    looked_at: as of `find_contradicted`.
    """
    if ledger.dim == _PLANE_DIM:
        columns, source = (ledger.z, ledger.noise, ledger.bound), solver.covariances
        if (found := source.try_contradicted(ledger.is_tested, looked_at, ledger.ends, columns, out)) is not None:
            return found
    tested, (_, most, look) = ledger.tested(), looked_at
    if tested.size > most:
        tested = tested[(look * most + np.arange(most)) % tested.size]
    worst = _worst(solver, ledger, tested, out)
    if not worst.size:
        return -1
    ledger.bound[worst] = weights_without(closure_numbers(solver, ledger, worst))
    d2 = residuals_weighed(solver, ledger, worst)
    return int(worst[d2.argmax()]) if float(d2.max()) > out else -1


def _worst(solver: Solver, ledger: Ledger, tested: I64, out: float) -> I64:
    """The worst first of those whose d² is beyond `out` by their bounds."""
    most_likely = residuals_weighed(solver, ledger, tested)
    worst = np.flatnonzero(~(most_likely <= out))
    order = np.argsort(-np.nan_to_num(most_likely[worst], nan=np.inf), kind="stable")
    return tested[worst[order[:WORST]]]


def _rows(ledger: Ledger, rows: I64, chosen: Chosen) -> list[_Row]:
    return [
        (c, ACCEPTED if reason in _BELIEVED else SUSPECT, reason, float(d2), float(p), c.tried)
        for c, reason, d2, p in zip(
            (ledger.closures[row] for row in rows.tolist()), chosen.reasons, chosen.distance, chosen.chance, strict=True
        )
    ]
