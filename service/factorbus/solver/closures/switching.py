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
from factorbus.solver.closures.ledger import Closure, ClosureLedger, ClosureVerdicts
from factorbus.solver.divergence import copied
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.groups import FactorsLike
from factorbus.solver.kernels.jit.compile import F64, I64
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
    def additions(self) -> list[FactorsLike]:
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
    named = ledger.named(verdicts.factors.tolist())
    for c, state, reason in zip(named, verdicts.states, verdicts.reasons, strict=True):
        would_be_in = c.would_be_in(state, reason)
        if c.is_in and not would_be_in:
            out.append(c)
        elif would_be_in and not c.is_in:
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


def without_factors(solver: Solver, factors: Sequence[int]) -> Solver:
    """A solver of the same map without these, after a step; `solver` stays as it is.  Raises SolverError."""
    changes, other = [FactorsRemoved(np.array(factors))], copied(solver)
    return other if try_change(other, changes) is not None else with_changes(other, changes)[0]
