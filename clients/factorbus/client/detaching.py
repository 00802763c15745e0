"""A part that was attached to the rest of its map, apart again: what `attach` did is taken back.

    joined = attach(hall, "b", candidates)
    undo_attach(hall, joined)                        # it was the wrong building after all

The part is as it was before, in its own frame, held by what held it there; what its robot has sent since stays with it.
"""

from __future__ import annotations

import numpy as np

from factorbus.client.arguments import of_type
from factorbus.client.attaching import Attached, AttachedPart, changes_of_frame, what_holds
from factorbus.client.changes import FactorsOfAnother
from factorbus.client.frames import compose, inverse
from factorbus.client.map import Map
from factorbus.client.merging import AbsoluteFactors, CannotMerge, as_trusted, hold_in_any_frame, keys_named
from factorbus.client.parts import split_by_letters
from factorbus.client.roles import roles_of
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Accepted, Batch
from factorbus.proto.roles import pick_factors

_JOINED = (
    "the part is joined to the rest by more than what attached it, by {}, which would pull it out of its own frame; "
    "nothing was changed. Remove these factors first (`Changes().remove_factors`), if they are false too"
)
_HELD = (
    "the part says since where it is in the map's frame ({}), which would be wrong in its own; nothing was changed. "
    "Remove these factors first, and free what is fixed"
)


def undo_attach(here: Map, attached: Attached, *, settle: bool = False, timeout_s: float | None = None) -> Accepted:
    """Take back what `attach` did: the candidates go, and the part is held in its own frame by what held it there.

    One insert.  Its fixed pose has the very value that it had; of a part that priors held the rest of the way is the
    solver's, so `settle` it.  Poses that its robot has sent since go along.  What was sent to join it to the rest, or
    says where it is in the map's frame, is in the way, and is named.
    `Changes().undo` is not for this: it takes away what an insert brought, and brings back nothing that was changed.
    Raises CannotMerge, AbsoluteFactors, FactorsOfAnother: nothing was sent.  Raises Refused (the map is as it was),
    Unavailable.
    """
    of_type("here", here, Map, "a Map")
    of_type("attached", attached, Attached, "an Attached, which `attach` gives")
    part, accepted = attached.part, attached.accepted
    if part is None or accepted is None:
        raise CannotMerge("nothing was attached (`accepted` is None); wanted an Attached of which the part was")
    if accepted.epoch != here.epoch:
        raise FactorsOfAnother(accepted.epoch, here.name, here.epoch)
    # 1. The part as it is now, without the candidates; nothing else may hold it where it is.
    graph = _without(here.graph(timeout_s).batch, part.anchors)
    now, _ = split_by_letters(graph, part.letters, _JOINED)
    roles = roles_of(graph)
    alone = [(group, ~hold_in_any_frame(group, roles)) for group in now.factors]
    if held := what_holds(now, alone):
        raise AbsoluteFactors(held, _HELD)
    _check_there(now, part)
    # 2. One insert.
    changes, turned = changes_of_frame(now, alone, roles, inverse(_frame(now, attached, part)), part.anchors)
    changes.place(part.held.variables)
    if keys := [key for group in part.held.variables for key in group.keys.tolist()]:
        changes.fix(keys)
    batch = Batch((), (*turned, *(group._replace(ids=None) for group in part.held.factors)))
    sent = as_trusted(batch) if here.closures != "trust" else batch
    return here.insert(sent, changes=changes, settle=settle, timeout_s=timeout_s)


def _without(graph: Batch, ids: I64) -> Batch:
    """The graph without these factors.  Raises CannotMerge: some are gone."""
    factors, found = [], 0
    for group in graph.factors:
        which = np.isin(group.ids, ids) if group.ids is not None else np.zeros(len(group.keys), bool)
        found += int(which.sum())
        if not which.all():
            factors.append(pick_factors(group, ~which))
    if found < ids.size:
        raise CannotMerge(
            f"of the {ids.size} candidates that hold the part {ids.size - found} are gone from the map: it was taken "
            "back already, or poses of them went, and what they said is in other factors; nothing was changed"
        )
    return graph._replace(factors=tuple(factors))


def _check_there(now: Batch, part: AttachedPart) -> None:
    """What held the part can hold it again.  Raises CannotMerge."""
    named = [group.keys.ravel() for group in (*part.held.variables, *part.held.factors)]
    lost = np.setdiff1d(np.concatenate(named), np.concatenate([group.keys for group in now.variables]))
    if lost.size:
        raise CannotMerge(
            f"the part was held in its own frame at {keys_named(lost)}, gone since; nothing was changed. Fix a pose of "
            "the part and remove the candidates instead: `Changes().fix(...).remove_factors(attached.part.anchors)`"
        )


def _frame(now: Batch, attached: Attached, part: AttachedPart) -> F64:
    """Where the part's own frame lies: by a pose that was fixed in it; else as it was when it was attached."""
    for group in part.held.variables:
        if group.kind in ("se2", "se3") and group.values is not None:
            for present in now.variables:
                row = np.flatnonzero(present.keys == group.keys[0])
                if row.size and present.values is not None:
                    return compose(present.values[row[0]], inverse(group.values[0])[None])[0]
    if attached.alignment.frame is None:
        raise CannotMerge("the alignment has no frame; wanted an Attached as `attach` gave it")
    return attached.alignment.frame
