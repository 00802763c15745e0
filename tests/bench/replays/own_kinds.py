"""A replay in own kinds: the same measurements, their kinds written as formulas."""

from collections.abc import Iterable

import numpy as np
from naive.own_formulas import OWN

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver

from .compose import first_values

USUAL = {own.name: name for name, own in OWN.items()}


def with_values(batches: Iterable[Batch]) -> list[Batch]:
    """The same, new poses composed from the estimate of a replay: an own kind gives no value to a variable."""
    solver, made, values = Solver(Options()), [], dict[int, np.ndarray]()
    for batch in batches:
        found = first_values(batch, lambda _kind, key: values[key])
        variables = tuple(
            group._replace(values=np.array([found[key][1] for key in group.keys.tolist()])) for group in batch.variables
        )
        made.append(batch._replace(variables=variables))
        solver.stage(made[-1])
        solver.step()
        for group in solver.estimate():
            values.update(zip(group.keys.tolist(), group.values, strict=True))
    return made


def in_own_kinds(batch: Batch) -> Batch:
    """The same with formulas in place of the solver's kinds."""
    factors = [group._replace(kind=OWN[group.kind].name) if group.kind in OWN else group for group in batch.factors]
    return batch._replace(factors=tuple(factors))


def in_usual_kinds(batch: Batch) -> Batch:
    """And back again."""
    return batch._replace(factors=tuple(g._replace(kind=USUAL.get(g.kind, g.kind)) for g in batch.factors))
