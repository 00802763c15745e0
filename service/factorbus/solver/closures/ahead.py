"""Closures judged before the step of their batch, so that what the map expects goes in with one step.

The covariance of both ends is that of poses that the last step left, and of the odometry that leads on from them
(`kernels/closures/ahead`).  It can be done for poses in the plane, in the mode "bayes-tree", where a batch brings new
poses one after the other and nothing else; other closures are judged after a step.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.choosing import PASSED, ClosureLimits
from factorbus.solver.closures.evidence import volume_of
from factorbus.solver.closures.ledger import ACCEPTED, NEW, SUSPECT, Closure, ClosureLedger
from factorbus.solver.closures.loops import SplitFactors
from factorbus.solver.closures.policy import ClosurePolicy
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
    ends: I64
    distance: list[float]
    chance: list[float]


@dataclass(frozen=True, slots=True)
class StagedBatch:
    """A batch that waits for its step, with those of its closures that are believed already.

    first: the id of its first factor, were all in; row: where its first row is.  believed: of each closure.
    """

    split: SplitFactors
    first: int
    row: int
    believed: Sequence[bool]
    foreseen: Foreseen | None


def stage_with_believed(
    solver: Solver, ledgers: ClosureLedger, batch: BatchLike, split: SplitFactors, policy: ClosurePolicy,
    limits: ClosureLimits,
) -> StagedBatch:  # fmt: skip
    """Stage `batch`, but for closures that are not believed before its step.  Raises as `stage` does."""
    graph = solver._graph
    before = graph.mark()
    first = solver.stage(batch)
    row = before[at.FACTORS]
    rows = graph.rows_of(first + split.closing_at) if graph.counts.item(at.MEMBERS) else row + split.closing_at
    foreseen = _foresee(solver, split, rows, before, volume_of(limits.spread))
    if foreseen is None:
        believed = [False] * len(split.closing)
    else:
        most = policy.closure_chance_max / ledgers.of_kind[_PLANE].odds()
        believed = [d2 <= limits.gate and p <= most for d2, p in zip(foreseen.distance, foreseen.chance, strict=True)]
    staged = StagedBatch(split, first, row, believed, foreseen)
    if not all(believed):
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
    if not all(staged.believed):
        places = np.concatenate([split.trusted_at, split.closing_at[np.array(staged.believed)]])
        rows = np.arange(staged.row, graph.counts.item(at.FACTORS))
        graph.rename_last(first + places[graph.ids_of(rows) - first], first + split.count)
    if seen is None:
        placed = zip(split.closing, split.closing_at.tolist(), strict=True)
        return [ledgers.add(factor, first + place, graph, revision) for factor, place in placed]
    if any(staged.believed):
        ledgers.looks += 1
        ledgers.moved_at = ledgers.looks
    made, bounds = list[Closure](), seen.numbers[:, ahead.J_BOUND : ahead.J_MEASURED]
    if not all(staged.believed):
        out = ~np.array(staged.believed)
        bounds[out] = np.linalg.inv(seen.numbers[out, ahead.J_ALLOWED : ahead.J_NOISE])
    for k, place in enumerate(split.closing_at.tolist()):
        state, reason = (ACCEPTED, PASSED) if staged.believed[k] else (SUSPECT, NEW)
        told = state, reason, seen.distance[k], seen.chance[k], revision
        made.append(Closure(first + place, 0, split.closing[k], revision, *told))
    z, noise = seen.numbers[:, ahead.J_MEASURED :], seen.numbers[:, ahead.J_NOISE : ahead.J_WEIGHT]
    ledgers.enter(_PLANE, made, seen.ends, z, noise, bounds)
    return made


def _foresee(solver: Solver, split: SplitFactors, closing: I64, before: Mark, volume: float) -> Foreseen | None:
    """What the map expects of closures in the rows `closing`, which are staged; None: it takes the step to say.

    volume: where false ones are.
    """
    n, graph = closing.size, solver._graph
    for factor in split.closing:
        if factor.kind != _PLANE:
            return None
    free, ends, moved = np.empty(2 * n, np.int64), np.empty((2 * n, 2), np.int64), np.empty((2 * n, ahead.MOVED))
    table = graph.array_table
    count = ahead.list_closure_ends(before[at.VARIABLES], before[at.FACTORS], closing, table, free, ends, moved)
    if count < 0 or (known := solver.covariances.try_joint(free[:count])) is None:
        return None
    numbers = np.empty((n, ahead.J_SIZE, 3))
    ahead.judge_ahead(closing, table, ends, moved, known, numbers)
    chance = [min(right / volume, 1.0) for right in numbers[:, 0, 1].tolist()]
    return Foreseen(numbers, graph.fac[closing, at.F_I : at.F_J + 1], numbers[:, 0, 0].tolist(), chance)
