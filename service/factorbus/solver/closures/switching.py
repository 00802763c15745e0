"""Closures that go out of a map and come back, under the ids that they have.

1  `planned_switch` says of verdicts which factors go and which come
2  a step makes that, as it makes any change
3  `note_switch` names what has come, and writes the verdicts down in the ledger
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.closures.ledger import BELIEVED, Closure, ClosureLedger, ClosureVerdicts
from factorbus.solver.closures.loops import SplitFactors
from factorbus.solver.divergence import copied
from factorbus.solver.graph.admission import admit
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import BatchLike, FactorGroup
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.solver import Solver


class ClosureSwitch(NamedTuple):
    """What verdicts ask of a map.  out: closures that go; into: that come."""

    out: tuple[Closure, ...]
    into: tuple[Closure, ...]

    @property
    def removals(self) -> list["FactorsRemoved"]:
        """The change that takes out what goes."""
        return [FactorsRemoved(np.array([c.factor_id for c in self.out]))] if self.out else []

    @property
    def additions(self) -> list[FactorGroup]:
        """What comes."""
        return [c.factor for c in self.into]


@dataclass(frozen=True, slots=True)
class FactorsRemoved:
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


def planned_switch(ledger: ClosureLedger, verdicts: ClosureVerdicts) -> ClosureSwitch:
    """What `verdicts` ask of a map.  Raises NotAClosure."""
    out, into = [], []
    for c, state in zip(ledger.named(verdicts.factors.tolist()), verdicts.states, strict=True):
        believed = state in BELIEVED
        if c.is_in and not believed:
            out.append(c)
        elif believed and not c.is_in:
            into.append(c)
    return ClosureSwitch(tuple(out), tuple(into))


def note_switch(
    graph: FactorGraph,
    ledger: ClosureLedger,
    verdicts: ClosureVerdicts,
    switch: ClosureSwitch,
    following: int,
    revision: int,
) -> list[Closure]:
    """The step is made that `switch` asks for; what came has the last rows.  Gives closures whose state is another.

    following: the id that the next factor gets.
    """
    if switch.into:
        graph.rename_last(np.array([c.factor_id for c in switch.into]), following)
    return ledger.note(verdicts, revision)


def check_whole(graph: FactorGraph, batch: BatchLike) -> None:
    """Whether all of a batch could go in, closures too.  Raises as `stage` does; nothing has changed either way."""
    mark = graph.mark()
    admit(graph, batch)
    graph.forget(mark)


def add_closures(
    graph: FactorGraph, ledger: ClosureLedger, split: SplitFactors, first: int, revision: int
) -> list[Closure]:
    """The trusted factors of an insert are in, in the last rows: name them, and its closures, as if all were in.

    first: the id of the first one.
    """
    if not split.closing:
        return []
    if split.trusted_at.size:
        rows = np.arange(int(graph.rows_of(np.array([first]))[0]), int(graph.counts[at.FACTORS]))
        names = first + split.trusted_at[graph.ids_of(rows) - first]
    else:
        names = np.empty(0, np.int64)
    graph.rename_last(names, first + split.trusted_at.size + split.closing_at.size)
    return [
        ledger.add(factor, first + place, graph, revision)
        for factor, place in zip(split.closing, split.closing_at.tolist(), strict=True)
    ]


def without_factors(solver: Solver, factors: Sequence[int]) -> Solver:
    """A solver of the same map without these, after a step; `solver` stays as it is.  Raises SolverError."""
    changes, other = [FactorsRemoved(np.array(factors))], copied(solver)
    return other if try_change(other, changes) is not None else with_changes(other, changes)[0]
