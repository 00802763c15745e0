"""Closures judged before the step of their batch, so that what the map expects goes in with one step.

The covariance of both ends is that of poses that the last step left, and of the odometry that leads on from them
(`kernels/closures/ahead`).  It can be done for poses in the plane, in the mode "bayes-tree", where a batch brings new
poses one after the other and nothing else; other closures are judged after a step.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.choosing import PASSED
from factorbus.solver.closures.judging import ClosureJudge
from factorbus.solver.closures.ledger import ACCEPTED, NO_VERDICTS, Closure, ClosureLedger, ClosureVerdicts
from factorbus.solver.closures.loops import SplitFactors
from factorbus.solver.graph.factor_graph import Mark
from factorbus.solver.graph.groups import Addition, BatchLike
from factorbus.solver.kernels.closures import ahead
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.solver import Solver

_PLANE = "between_se2"


class Foreseen(NamedTuple):
    """What the map expects of some closures: their judgements as `judge_ahead` has them, and d² and odds of each."""

    numbers: F64
    ends: I64  # as `list_closure_ends` has them
    distance: list[float]
    chance: list[float]


class StagedBatch(NamedTuple):
    """A batch that waits for its step, with those of its closures that are believed already.

    first: the id of its first factor, were all in; row: where its first row is.  believed: of each closure.
    given: verdicts that say which are, as somebody who judged had them; None: they follow from `foreseen`.
    all_in: whether all are believed.
    """

    split: SplitFactors
    first: int
    row: int
    believed: Sequence[bool]
    foreseen: Foreseen | None
    given: ClosureVerdicts | None = None
    all_in: bool = False

    def verdicts(self) -> ClosureVerdicts:
        """On those that are believed."""
        if self.given is not None or self.foreseen is None:
            return self.given or NO_VERDICTS
        which = np.flatnonzero(self.believed)
        distance, chance = np.array(self.foreseen.distance)[which], np.array(self.foreseen.chance)[which]
        states, reasons = (ACCEPTED,) * which.size, (PASSED,) * which.size
        ids = self.first + self.split.closing_at[which]
        return ClosureVerdicts(ids, states, reasons, distance, chance, np.full(which.size, -1))


def stage_with_believed(
    solver: Solver, ledgers: ClosureLedger, batch: BatchLike, split: SplitFactors, judge: ClosureJudge,
    given: ClosureVerdicts | None = None,
) -> StagedBatch:  # fmt: skip
    """Stage `batch`, but for closures that are not believed before its step.  Raises as `stage` does.

    given: verdicts on those that are, of a batch that was judged before.
    """
    graph = solver._graph
    before = graph.mark()
    first = solver.stage(batch)
    row, foreseen = before[at.FACTORS], None
    if given is None:
        rows = graph.rows_of(first + split.closing_at) if graph.counts.item(at.MEMBERS) else row + split.closing_at
        foreseen = _foresee(solver, split, rows, before, judge.volume)
    if foreseen is None:
        believed = np.isin(first + split.closing_at, () if given is None else given.factors).tolist()
    else:
        gate, out, _ = judge.limits[3]
        most = judge.policy.closure_chance_max / ledgers.of_kind[_PLANE].odds().false
        believed = [d2 <= gate and p <= most for d2, p in zip(foreseen.distance, foreseen.chance, strict=True)]
        if not all(believed) and any(
            d2 <= out and not is_in for d2, is_in in zip(foreseen.distance, believed, strict=True)
        ):
            believed = [False] * len(believed)  # it may speak against the others: they are judged together
    staged = StagedBatch(split, first, row, believed, foreseen, given, all(believed))
    if not staged.all_in:
        graph.forget(before)
        restage(solver, batch, staged)
    return staged


def restage(solver: Solver, batch: BatchLike, staged: StagedBatch) -> None:
    """Stage what is trusted, and the closures that are believed."""
    believed = [c for c, is_in in zip(staged.split.closing, staged.believed, strict=True) if is_in]
    solver.stage(Addition(batch.variables, [*staged.split.trusted, *believed]))


def enter_closures(solver: Solver, ledgers: ClosureLedger, staged: StagedBatch, revision: int) -> list[Closure]:
    """The step of a batch is made: name its factors as if all were in, and write down its closures; gives those."""
    split, graph, first, seen = staged.split, solver._graph, staged.first, staged.foreseen
    if staged.all_in and seen is not None:
        return _enter_expected(ledgers, split, first, seen, revision)
    is_in = np.array(staged.believed)
    if not staged.all_in:
        places = np.concatenate([split.trusted_at, split.closing_at[is_in]])
        rows = np.arange(staged.row, graph.counts.item(at.FACTORS))
        graph.rename_last(first + places[graph.ids_of(rows) - first], first + split.count)
    if seen is None:
        placed = zip(split.closing, split.closing_at.tolist(), strict=True)
        added = [ledgers.add(factor, first + place, graph, revision) for factor, place in placed]
        if is_in.any():
            ledgers.note(staged.verdicts(), revision)
        return added
    bounds = seen.numbers[:, ahead.J_BOUND : ahead.J_MEASURED]
    if not is_in.all():
        bounds[~is_in] = np.linalg.inv(seen.numbers[~is_in, ahead.J_ALLOWED : ahead.J_NOISE])
    made = list[Closure]()
    for k, place in enumerate(split.closing_at.tolist()):
        if staged.believed[k]:
            told = ACCEPTED, PASSED, seen.distance[k], seen.chance[k], revision
            made.append(Closure(first + place, 0, split.closing[k], revision, *told))
        else:
            made.append(Closure(first + place, 0, split.closing[k], revision, changed=revision))
    z, noise = seen.numbers[:, ahead.J_MEASURED :], seen.numbers[:, ahead.J_NOISE : ahead.J_WEIGHT]
    ledgers.enter(_PLANE, made, seen.ends[:, ahead.END_ITSELF].reshape(-1, 2), z, noise, bounds)
    return made


def _enter_expected(
    ledgers: ClosureLedger, split: SplitFactors, first: int, seen: Foreseen, revision: int
) -> list[Closure]:
    """The same where all went in with the step, as the map expected."""
    row, numbers = len(ledgers.of_kind[_PLANE].closures), seen.numbers
    each = zip(split.closing, split.closing_at.tolist(), seen.distance, seen.chance, strict=True)
    made = [
        Closure(first + place, n, factor, revision, ACCEPTED, PASSED, d2, p, revision)
        for n, (factor, place, d2, p) in enumerate(each, row)
    ]
    ledgers.enter_accepted(_PLANE, made, seen.ends, numbers)
    return made


def _foresee(solver: Solver, split: SplitFactors, closing: I64, before: Mark, volume: float) -> Foreseen | None:
    """What the map expects of closures in the rows `closing`, which are staged; None: it takes the step to say.

    volume: where false ones are.
    """
    for factor in split.closing:
        if factor.kind != _PLANE:
            return None
    n = closing.size
    ends, numbers = np.empty((2 * n, ahead.END_COLUMNS), np.int64), np.empty((n, ahead.J_SIZE, 3))
    if not solver.covariances.try_foresee(before[at.VARIABLES], before[at.FACTORS], closing, ends, numbers):
        return None
    told = numbers[:, 0].tolist()
    distance, chance = [one[0] for one in told], [min(one[1] / volume, 1.0) for one in told]
    return Foreseen(numbers, ends, distance, chance)
