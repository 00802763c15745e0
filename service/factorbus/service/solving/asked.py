"""What a user's insert with changes asks of a map that tests its closures, of which some are not in the graph."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from factorbus.proto.messages import Change, Insert
from factorbus.service.core.events import Arrived
from factorbus.solver.closures.ledger import (
    ACCEPTED,
    NO_VERDICTS,
    REJECTED,
    RESTORED,
    SUSPECT,
    ClosureLedger,
    ClosureVerdicts,
)
from factorbus.solver.closures.naming import SwitchedOff
from factorbus.solver.closures.switching import ClosureSwitch, planned_switch
from factorbus.solver.errors import NamedTwice

_SAYS = {"accept": RESTORED, "reject": REJECTED}


class AskedChanges(NamedTuple):
    """made: the insert that does it.  gone: closures that are removed and were out."""

    made: Arrived
    said: ClosureVerdicts
    switch: ClosureSwitch
    gone: set[int]


def asked_changes(ledger: ClosureLedger, insert: Arrived, content: Insert) -> AskedChanges:
    """What changes come to in a map with this ledger.  Raises SolverError."""
    said, left, gone, freed = list[ClosureVerdicts](), list[Change](), set[int](), list[int]()
    for change in content.changes:
        ids = [] if change.factors is None else change.factors.tolist()
        if change.change in _SAYS:
            said.append(ledger.said(ids, _SAYS[change.change]))
            freed += _weighed_of(ledger, ids) if change.change == "accept" else []
            continue
        out = [factor for factor in ids if (c := ledger.of_factor.get(factor)) is not None and not c.is_in]
        if out and change.change != "remove_factors":
            raise SwitchedOff(change.change, out[0], ledger.of_factor[out[0]].state)
        if change.change == "loss" and (own := _weighed_of(ledger, ids)):
            said.append(ledger.said(own, RESTORED))  # its sender weighs it from now on
        _check_once(change.change, [*gone, *out])
        gone |= set(out)
        if not out or len(out) < len(ids):
            left.append(change._replace(factors=np.array([i for i in ids if i not in gone])) if out else change)
    verdicts = _together(said)
    switch = planned_switch(ledger, verdicts)
    _check_apart(verdicts, switch, gone, left)
    removals = [Change("remove_factors", removal.factors) for removal in switch.removals]
    removals += [Change("loss", np.array(freed))] if freed else []
    batch: Any = content.batch._replace(factors=(*content.batch.factors, *switch.additions))
    made = content._replace(batch=batch, changes=(*removals, *left))
    return AskedChanges(insert._replace(content=made), verdicts, switch, gone)


def _weighed_of(ledger: ClosureLedger, ids: Sequence[int]) -> list[int]:
    """Those of them that are in, with a loss by which the map weighs them."""
    found = (ledger.of_factor.get(factor) for factor in ids)
    return [c.factor_id for c in found if c and c.is_weighed and c.is_in and c.state in (ACCEPTED, SUSPECT)]


def _together(said: Sequence[ClosureVerdicts]) -> ClosureVerdicts:
    if not said:
        return NO_VERDICTS
    columns = zip(*said, strict=True)
    factors, states, reasons, distance, chance, tried = columns
    return ClosureVerdicts(
        np.concatenate(factors), sum(states, ()), sum(reasons, ()), np.concatenate(distance), np.concatenate(chance),
        np.concatenate(tried),
    )  # fmt: skip


def _check_apart(verdicts: ClosureVerdicts, switch: ClosureSwitch, gone: set[int], left: Sequence[Change]) -> None:
    """No closure is removed and accepted or rejected in one insert, and none that goes out is edited in it.

    Raises NamedTwice.
    """
    said = verdicts.factors.tolist()
    _check_once("accept, reject and remove_factors", [*said, *gone])
    goes = {closure.factor_id for closure in switch.out}
    for change in left:
        ids = set() if change.factors is None else set(change.factors.tolist())
        removes = change.change == "remove_factors"
        what = "accept, reject and remove_factors" if removes else f"reject and {change.change}"
        _check_once(what, [*said, *ids.intersection(said if removes else goes)])


def _check_once(what: str, factors: Sequence[int]) -> None:
    """Raises NamedTwice."""
    known = set[int]()
    for factor in factors:
        if factor in known:
            raise NamedTwice(what, f"factor {factor}", factor=factor)
        known.add(factor)
