"""Closures judged before the step of their batch, so that what the map expects goes in with one step.

The covariance of both ends is that of poses that the last step left, and of the odometry that leads on from them
(`kernels/closures/ahead`).  It can be done for poses in the plane, in the mode "bayes-tree", where a batch brings new
poses one after the other and nothing else; other closures are judged after a step.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.choosing import PASSED
from factorbus.solver.closures.expected import ExpectedClosures
from factorbus.solver.closures.judging import ClosureJudge
from factorbus.solver.closures.ledger import ACCEPTED, NO_VERDICTS, Closure, ClosureLedger, ClosureVerdicts, Ledger
from factorbus.solver.closures.loops import SplitFactors
from factorbus.solver.graph.groups import Addition, BatchLike
from factorbus.solver.kernels.closures import ahead
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.solver import Solver

_PLANE = "between_se2"
_new = tuple.__new__  # of a named tuple: its own way there is one more function, in code that is cold


class Foreseen(NamedTuple):
    """What the map expects of some closures, as `foresee_closures` has it.

    numbers: their judgements.  believed: how many go in with the step.
    """

    numbers: F64
    believed: int

    @property
    def odds(self) -> F64:
        """(n, 3): d², the odds of the residual, and whether it is believed, of each."""
        return self.numbers[:, ahead.J_ODDS]


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
        distance, chance, _ = self.foreseen.odds[which].T.copy()
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
    before = graph.counts.tolist()
    first, row, foreseen = solver.stage(batch), before[at.FACTORS], None
    if given is None:
        places = split.places
        if graph.counts.item(at.MEMBERS):
            rows = graph.rows_of(first + split.closing_at).tolist()
        else:
            rows = [row + place for place in places]
        ledger = ledgers.of_kind[_PLANE]
        new = np.array([before[at.VARIABLES], row, ledger.count, ledgers.looks + 1, *rows])
        foreseen = _foresee(solver, ledger, split, new, judge.limits_ahead(solver, ledger))
        if foreseen is not None and foreseen.believed == len(places):
            return _new(StagedBatch, (split, first, row, [True] * len(places), foreseen, None, True))
    if foreseen is None:
        believed = np.isin(first + split.closing_at, () if given is None else given.factors).tolist()
    else:
        believed = (foreseen.odds[:, ahead.J_BELIEVED] > 0.0).tolist()
    staged = StagedBatch(split, first, row, believed, foreseen, given, all(believed))
    if not staged.all_in:
        graph.forget(tuple(before))
        restage(solver, batch, staged)
    return staged


def restage(solver: Solver, batch: BatchLike, staged: StagedBatch) -> None:
    """Stage what is trusted, and the closures that are believed."""
    believed = [c for c, is_in in zip(staged.split.closing, staged.believed, strict=True) if is_in]
    solver.stage(Addition(batch.variables, [*staged.split.trusted, *believed]))


def enter_closures(solver: Solver, ledgers: ClosureLedger, staged: StagedBatch, revision: int) -> Sequence[Closure]:
    """The step of a batch is made: name its factors as if all were in, and write down its closures; gives those."""
    split, graph, first, seen = staged.split, solver._graph, staged.first, staged.foreseen
    if staged.all_in and seen is not None:
        row, odds = ledgers.of_kind[_PLANE].count, seen.numbers[:, ahead.J_ODDS]
        expected = ExpectedClosures(split.closing, split.places, first, row, odds, revision)
        ledgers.enter_expected(_PLANE, expected, len(split.places))
        return expected
    is_in = np.array(staged.believed)
    if not staged.all_in:
        places = np.concatenate([split.trusted_at, split.closing_at[is_in]])
        rows = np.arange(staged.row, graph.counts.item(at.FACTORS))
        graph.rename_last(first + places[graph.ids_of(rows) - first], first + split.count)
    if seen is None:
        placed = zip(split.closing, split.places, strict=True)
        added = [ledgers.add(factor, first + place, graph, revision) for factor, place in placed]
        if is_in.any():
            ledgers.note(staged.verdicts(), revision)
        return added
    if not is_in.all():
        ledger = ledgers.of_kind[_PLANE]
        ledger.bound[ledger.count + np.flatnonzero(~is_in)] = np.linalg.inv(
            seen.numbers[~is_in, ahead.J_ALLOWED : ahead.J_NOISE]
        )
    made, odds = list[Closure](), seen.odds.tolist()
    for k, place in enumerate(split.places):
        if staged.believed[k]:
            told = ACCEPTED, PASSED, odds[k][ahead.J_DISTANCE], odds[k][ahead.J_CHANCE], revision
            made.append(Closure(first + place, 0, split.closing[k], revision, *told))
        else:
            made.append(Closure(first + place, 0, split.closing[k], revision, changed=revision))
    ledgers.enter(_PLANE, made)
    return made


def _foresee(solver: Solver, ledger: Ledger, split: SplitFactors, staged: I64, limits: F64) -> Foreseen | None:
    """What the map expects of closures that are staged, whose columns are written behind those of `ledger`; None: it
    takes the step to say.

    staged: as of `foresee_closures`.  limits: as of `believe_ahead`.
    """
    if split.kind != _PLANE:
        return None
    n = len(split.closing)
    if ledger.count + n > len(ledger.z):
        ledger.make_room(n)
    numbers = np.empty((n, ahead.J_SIZE, 3))
    columns, marks = (ledger.z, ledger.noise, ledger.bound), (ledger.ends, ledger.looked, ledger.is_tested)
    believed = solver.covariances.try_foresee(staged, limits, columns, marks, numbers)
    return None if believed < 0 else _new(Foreseen, (numbers, believed))
