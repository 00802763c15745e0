"""What closures are, judged by the estimate: nothing is changed here.

    look        new ones and a few suspects are judged together (`choosing`); those that are believed are to go in
    look_back   of the closures that are in, the worst is judged against all others; an improbable one is to go out

Where suspects agree that the map calls improbable, one place's closures are taken out of a copy of the solver, on
trial: they are to stay out if more places' closures are believed then.

All of it follows from the estimate and the ledger: the same ones give the same verdicts.
"""

from typing import TypeAlias

import numpy as np

from factorbus.solver.closures.choosing import AGREES, PASSED, UNSURE, Chosen, choose_closures, closure_places
from factorbus.solver.closures.evidence import ClosureNumbers, judge_accepted
from factorbus.solver.closures.ledger import (
    ACCEPTED,
    SUSPECT,
    Closure,
    ClosureLedger,
    ClosureVerdicts,
    Ledger,
    verdicts_of,
)
from factorbus.solver.closures.motions import inverse_motion, motions_of_poses, tangent_of
from factorbus.solver.closures.policy import ClosurePolicy
from factorbus.solver.closures.switching import without_factors
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.gates import threshold
from factorbus.solver.errors import SolverError
from factorbus.solver.kernels.jit.compile import I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.solver import Solver

CONTRADICTED = "contradicted"
_NEWEST = 40  # suspects, or accepted ones, among which places are looked for
_BELIEVED = {PASSED, AGREES}
_EXPECTED = 3.0  # rᵀ Ω r of one accepted closure that is worth a look, for each of its numbers
_WORST = 4  # accepted ones whose d² is computed in a step
_TOGETHER = 64  # new closures that are judged together: each two of them are compared
_RETRY = 2  # rivals that have to be new before the same closures are tried again

_Row: TypeAlias = tuple[Closure, str, str, float, float, int]


class ClosureJudge:
    """Judges the closures of a map."""

    def __init__(self, policy: ClosurePolicy | None = None) -> None:
        self.policy = policy or ClosurePolicy()

    def look(self, solver: Solver, ledgers: ClosureLedger, kind: str) -> ClosureVerdicts | None:
        """Judge new ones of a kind, the oldest where there are many, with some suspects; None: there is no new one.

        Raises SolverError.
        """
        ledger = ledgers.of_kind[kind]
        new = ledger.unjudged()[:_TOGETHER]
        if not new.size:
            return None
        looked_at = np.union1d(self._revisited(solver, ledgers, ledger, ledger.older_suspects()), new)
        chosen = self._chosen(solver, ledger, looked_at)
        rows = _rows(ledger, looked_at, chosen)
        if chosen.rivals and not any(reason in _BELIEVED for reason in chosen.reasons):
            tried = self._try_rivals(solver, ledger, looked_at[chosen.rivals])
            again = {row[0].factor_id for row in tried}
            rows = [row for row in rows if row[0].factor_id not in again] + tried
        return verdicts_of(rows)

    def look_back(self, solver: Solver, ledgers: ClosureLedger, kind: str) -> ClosureVerdicts | None:
        """The worst of those accepted, where it is improbable; None: none is.  Raises SolverError."""
        ledger = ledgers.of_kind[kind]
        tested, most = ledger.tested(), self.policy.closure_retests
        if tested.size > most:
            tested = tested[(ledgers.looks * most + np.arange(most)) % tested.size]
        if not tested.size:
            return None
        now = closure_numbers(solver, ledger, tested, False)
        r = tangent_of(inverse_motion(now.z) @ inverse_motion(now.a) @ now.b)
        own = np.einsum("na,nab,nb->n", r, ledger.weight[tested], r)
        worst = tested[np.argsort(-own, kind="stable")[:_WORST]]
        if float(own.max()) <= _EXPECTED * ledger.dim:
            return None
        d2 = judge_accepted(closure_numbers(solver, ledger, worst))
        found = ledger.closures[int(worst[int(d2.argmax())])]
        if float(d2.max()) <= float(threshold(np.array([ledger.dim]), self.policy.closure_out_probability)[0]):
            return None
        return verdicts_of([(found, SUSPECT, CONTRADICTED, float(d2.max()), found.chance, found.tried)])

    def _chosen(self, solver: Solver, ledger: Ledger, rows: I64) -> Chosen:
        ends, graph = ledger.ends[: len(ledger.closures)].reshape(-1), solver._graph
        places = graph.values[graph.var[ends, at.V_AT, None] + np.arange(2)]  # x, y of all poses with closures
        extent = float(np.ptp(places, axis=0).max()) / 2.0
        return choose_closures(closure_numbers(solver, ledger, rows), extent, self.policy)

    def _revisited(self, solver: Solver, ledgers: ClosureLedger, ledger: Ledger, suspects: I64) -> I64:
        """Suspects to look at again: of the newest that are unsure those of many places, the newest that are not, and,
        if the map has got or lost closures since, those that were not looked at for longest."""
        most, among = self.policy.closure_revisits, suspects[-4 * _NEWEST :]
        is_unsure = np.array([ledger.closures[row].reason == UNSURE for row in among.tolist()], bool)
        unsure = among[is_unsure][-_NEWEST:][::-1]
        if unsure.size:
            places = closure_places(closure_numbers(solver, ledger, unsure, False), self.policy.closure_place_m)
            before = [int((places[:k] == places[k]).sum()) for k in range(unsure.size)]  # newer ones of the same place
            unsure = unsure[np.argsort(before, kind="stable")][: most // 2]
        picked = np.concatenate([unsure, among[~is_unsure][::-1][: most // 4]])
        left = np.setdiff1d(suspects, picked)
        left = left[ledger.looked[left] < ledgers.moved_at]
        longest = left[np.argsort(ledger.looked[left], kind="stable")]
        return np.concatenate([picked, longest[: most - picked.size]])

    def _try_rivals(self, solver: Solver, ledger: Ledger, rivals: I64) -> list[_Row]:
        """Without the closures of one place: where more places' rivals are believed then, those go in instead."""
        tested = ledger.tested()[-_NEWEST:]
        ids = np.array([ledger.closures[row].factor_id for row in rivals.tolist()])
        newest = int(np.sort(ids)[-_RETRY])
        tested = tested[[ledger.closures[row].tried < newest for row in tested.tolist()]]
        if not tested.size:
            return []
        least_sure = int(np.argmax([ledger.closures[row].chance for row in tested.tolist()]))
        now, within = closure_numbers(solver, ledger, tested, False), self.policy.closure_place_m
        near = [np.linalg.norm(T[:, :-1, -1] - T[least_sure, :-1, -1], axis=1) <= within for T in (now.a, now.b)]
        on_trial = [ledger.closures[row] for row in tested[near[0] & near[1]].tolist()]
        stay = [(c, c.state, c.reason, c.distance, c.chance, int(ids.max())) for c in on_trial]
        try:
            without = without_factors(solver, [c.factor_id for c in on_trial])
        except SolverError:
            return stay  # the map does not stand without them
        chosen = self._chosen(without, ledger, rivals)
        believed = np.array([reason in _BELIEVED for reason in chosen.reasons])
        numbers = closure_numbers(without, ledger, rivals[believed], False)
        if not believed.any() or np.unique(closure_places(numbers, within)).size < 2:
            return stay
        return [(c, SUSPECT, CONTRADICTED, *row[3:]) for c, row in zip(on_trial, stay, strict=True)] + _rows(
            ledger, rivals, chosen
        )


def closure_numbers(solver: Solver, ledger: Ledger, rows: I64, with_covariance: bool = True) -> ClosureNumbers:
    """Of some closures, with the poses they are between as the solver has them."""
    ends, graph = ledger.ends[rows], solver._graph
    different, where = np.unique(ends, return_inverse=True)
    where = where.reshape(ends.shape)
    T = motions_of_poses(graph.values[graph.var[different, at.V_AT, None] + np.arange(ledger.size)])
    known = np.empty((0, 0))
    if with_covariance:
        source, d = solver.covariances, ledger.dim
        joint = CovarianceBlocks(source.try_view() or source.factored()).joint(different)
        scalars = (where.reshape(-1, 1) * d + np.arange(d)).reshape(-1)
        known = joint[np.ix_(scalars, scalars)]
    return ClosureNumbers(T[where[:, 0]], T[where[:, 1]], ledger.z[rows], ledger.noise[rows], known)


def _rows(ledger: Ledger, rows: I64, chosen: Chosen) -> list[_Row]:
    return [
        (c, ACCEPTED if reason in _BELIEVED else SUSPECT, reason, float(d2), float(p), c.tried)
        for c, reason, d2, p in zip(
            (ledger.closures[row] for row in rows.tolist()), chosen.reasons, chosen.distance, chosen.chance, strict=True
        )
    ]
