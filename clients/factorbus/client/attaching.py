"""A robot that began in a frame of its own, in the same map: brought into the frame of the others.

    hall.insert(Draft().se2("b0", (0, 0, 0), fixed=True))         # robot B, who does not know where it is
    candidates.between_se2("a10", "b4", (1, 0, 0), sigmas=(0.1, 0.1, 0.05))       # whenever a place is recognized
    found = attach(hall, "b", candidates)                         # one insert, once enough of them agree
    print(found.alignment)                                        # 12 of 31 agree, σ 0.04 m and 0.3°; ...

Until then the robot's part of the map stands by itself, held by its own fixed pose or its own prior, and both parts are
estimated, covariances too.  It is attached by one insert: its variables go to where they lie in the frame of the rest,
what held it alone goes, and the candidates that agree hold it from then on.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from factorbus.client.aligning import ALIGNED, Alignment, align_sides, kind_of_candidates, side_of
from factorbus.client.arguments import checked_flag, of_type
from factorbus.client.call_order import call_order
from factorbus.client.changes import Changes
from factorbus.client.draft import Draft, batch_of
from factorbus.client.map import Map
from factorbus.client.merging import (
    AbsoluteFactors,
    CannotMerge,
    as_trusted,
    hold_in_any_frame,
    is_gauge,
    keys_named,
)
from factorbus.client.parts import adrift, pairs_named, split_by_letters
from factorbus.client.roles import Roles, roles_of
from factorbus.client.transform_factors import transform_factors
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import name_of_kind
from factorbus.proto.messages import Accepted, Batch, Factors, Variables
from factorbus.proto.problems import Refused
from factorbus.proto.roles import keys_in_no_frame, pick_factors, pick_variables

_ABSOLUTE = ("refuse", "leave_out")
_TRIES = 3
_NONE = np.empty(0, np.int64)
_WORDS = (
    "the part says where it is in its own frame more than once ({}), which is wrong in that of the rest; "
    'nothing was attached. absolute="leave_out" attaches it without them'
)


@dataclass(frozen=True, slots=True)
class AttachedPart:
    """A part as it was before it was attached, for `undo_attach`.

    letters: of its keys.  anchors (n,): ids of the candidates that hold it.  held: the variables that were fixed, where
    they were, and the factors that are gone.
    """

    letters: str
    anchors: I64
    held: Batch


@dataclass(frozen=True, slots=True)
class Attached:
    """What came of it.

    accepted: the answer to the insert that attached it; None: the candidates do not say where it is yet, or say two
    things (`alignment.verdict`), and nothing has changed.  left_out: how many of each kind of what held it are gone
    ("fixed": variables that are now estimated).  part: what `undo_attach` puts back.
    """

    alignment: Alignment
    accepted: Accepted | None = None
    left_out: Mapping[str, int] = field(default_factory=dict)
    part: AttachedPart | None = field(default=None, repr=False)


def attach(
    here: Map,
    letters: str,
    candidates: Batch | Draft,
    *,
    absolute: str = "refuse",
    settle: bool = False,
    timeout_s: float | None = None,
) -> Attached:
    """Bring the part of a map whose keys have these letters into the frame of the rest, if candidates say where it is.

    letters: of the part, "b" or several, "bc".  candidates: `between_se2` or `between_se3` between a pose of the part
    and one of the rest, 500 at most, of which many may be false: those that agree are inserted, the others are not, and
    none of them may be in the map before.  absolute: what the part knows of its own frame beyond one fixed pose or one
    prior of a pose, which go: "refuse" if there is more (AbsoluteFactors), or "leave_out" all of it.

    The part is to be a part: a factor between it and the rest is refused (CannotMerge), and so is a part of which
    something hangs on no candidate that agrees.  Mounts, and numbers such as a bias or a scale, may be shared.  What
    robots insert meanwhile goes along with what it hangs on.  Of two that attach a part at once the second is refused:
    a factor of the part gets a new id, if none goes.
    Raises AbsoluteFactors, CannotMerge, BadSymbol, BadOption: nothing was sent.  Raises Refused (the map is as it was),
    Unavailable.
    """
    of_type("here", here, Map, "a Map")
    checked_flag("settle", settle)
    if absolute not in _ABSOLUTE:
        raise CannotMerge(f"absolute is {absolute!r}; wanted one of {', '.join(_ABSOLUTE)}")
    given, order = batch_of("candidates", candidates), call_order(candidates)
    for _ in range(_TRIES - 1):
        try:
            return _attach(here, letters, given, order, absolute, settle, timeout_s)
        except Refused as problem:
            # What the map had when it was asked is gone: the part is attached by another, or poses are taken out.
            if problem.code not in ("unknown_factor", "unknown_variable"):
                raise
    return _attach(here, letters, given, order, absolute, settle, timeout_s)


def _attach(
    here: Map, letters: str, given: Batch, order: Sequence[int], absolute: str, settle: bool, timeout_s: float | None
) -> Attached:
    kind = kind_of_candidates(given)
    # 1. The part, and that nothing joins it to the rest.
    graph = here.graph(timeout_s).batch
    part, rest = split_by_letters(graph, letters)
    # 2. What holds it in its own frame.
    roles = roles_of(graph)
    alone = [(group, ~hold_in_any_frame(group, roles)) for group in part.factors]
    held = what_holds(part, alone)
    if absolute == "refuse" and not is_gauge(part, held):
        raise AbsoluteFactors(held, _WORDS)
    # 3. Where it lies.
    sides = [[_places(g, roles) for g in groups] for groups in (rest, part.variables)]
    _check_candidates(given, kind, *sides)
    found = align_sides(side_of(here, sides[0], kind), side_of(here, sides[1], kind), given, order, timeout_s)
    if found.verdict != ALIGNED or found.frame is None:
        return Attached(found)
    anchors = found.anchors()
    _check_held(part, alone, anchors)
    if here.closures != "trust":
        _check_not_tested(here, anchors, timeout_s)
    # 4. One insert.
    changes, turned = changes_of_frame(part, alone, roles, found.frame)
    batch = Batch((), (*turned, *anchors.factors))
    sent = as_trusted(batch) if here.closures != "trust" else batch
    accepted = here.insert(sent, changes=changes, settle=settle, timeout_s=timeout_s)
    # 5. What would take it back.
    ids = accepted.first_factor + np.arange(Batch((), tuple(turned)).factor_count, batch.factor_count)
    gauge = Batch(
        tuple(group for group in moving_variables(part) if group.fixed),
        tuple(pick_factors(group, which) for group, which in alone if which.any()),
    )
    return Attached(found, accepted, held, AttachedPart(letters, ids, gauge))


def _places(group: Variables, roles: Roles) -> Variables:
    """Without mounts and the map's poses in other frames."""
    return pick_variables(group, ~np.isin(group.keys, np.concatenate([roles.mounts, roles.frames])))


def _check_candidates(given: Batch, kind: str, rest: Sequence[Variables], part: Sequence[Variables]) -> None:
    """Each is between a pose of the part and one of the rest.  Raises CannotMerge."""
    pairs = np.concatenate([group.keys for group in given.factors])
    of_rest, of_part = (
        np.isin(pairs, np.concatenate([np.empty(0, np.int64), *(g.keys for g in side if g.kind == kind)]))
        for side in (rest, part)
    )
    if not (known := of_rest | of_part).all():
        raise CannotMerge(
            f"candidates name {keys_named(np.unique(pairs[~known]))}, no {kind} in the map's frame; wanted poses that "
            "the map has: leave out candidates whose poses are gone (`Map.estimate` has those that are there)"
        )
    if (one_side := of_rest.all(axis=1) | of_part.all(axis=1)).any():
        raise CannotMerge(
            f"candidates are between two poses of one side: {pairs_named(pairs[one_side])}; wanted a pose of the part "
            "and one of the rest: insert those of one side into the map, and leave them out here"
        )


def _check_held(part: Batch, alone: Sequence[tuple[Factors, np.ndarray]], anchors: Batch) -> None:
    """All of the part hangs on a candidate that agrees: else it would go to a place that nobody measured."""
    keys = np.concatenate([np.empty(0, np.int64), *(group.keys for group in moving_variables(part))])
    ends = np.concatenate([group.keys.ravel() for group in anchors.factors])
    lost = adrift(keys, [pick_factors(group, ~which) for group, which in alone], ends)
    if lost.size:
        raise CannotMerge(
            f"no factor joins {keys_named(lost)} to a pose of a candidate that agrees, so that nothing says where "
            f"{'it is' if lost.size == 1 else 'they are'}; wanted a part that hangs together. Attach what hangs "
            "together one by one, under letters of its own, or give candidates of each"
        )


def _check_not_tested(here: Map, anchors: Batch, timeout_s: float | None) -> None:
    """None of them is a suspect already, which would count twice when it is believed.  Raises CannotMerge."""
    found = here.ask.suspects(False, timeout_s).result()
    pairs = np.sort(np.concatenate([group.keys for group in anchors.factors]), axis=1)
    pending = np.array([state == "suspect" for state in found.states], bool)
    same = pending & np.array([(pairs == np.sort(keys)).all(axis=1).any() for keys in found.keys], bool)
    if same.any():
        ids = ", ".join(map(str, found.factors[same].tolist()))
        raise CannotMerge(
            f"the map tests candidates that agree already, and may count them twice: {pairs_named(found.keys[same])}; "
            f"take these suspects out with `Changes().remove_factors([{ids}])`, and attach again"
        )


def moving_variables(part: Batch) -> list[Variables]:
    """All but mounts and plain numbers, which are the same in every frame."""
    aside = keys_in_no_frame(part)
    groups = [(group, ~np.isin(group.keys, aside)) for group in part.variables]
    return [pick_variables(group, chosen) for group, chosen in groups if chosen.any()]


def what_holds(part: Batch, alone: Sequence[tuple[Factors, np.ndarray]]) -> dict[str, int]:
    """How many of each kind hold the part in its own frame."""
    fixed = sum(group.keys.size for group in moving_variables(part) if group.fixed)
    held = {"fixed": fixed} if fixed else {}
    for group, which in alone:
        if which.any():
            name = name_of_kind(group.kind)
            held[name] = held.get(name, 0) + int(which.sum())
    return held


def changes_of_frame(
    part: Batch, alone: Sequence[tuple[Factors, np.ndarray]], roles: Roles, T: F64, also: I64 = _NONE
) -> tuple[Changes, list[Factors]]:
    """What brings the part to where it lies, T_a_b, and factors of it that have other numbers there.

    alone: of each group of its factors which go, as they hold it alone.  also (n,): ids of what goes, too.
    """
    gone, turned = [also], list[Factors]()
    for group, which in alone:
        gone.append(_ids(group)[which])
        if which.all():
            continue
        stay = pick_factors(group, ~which)
        there = transform_factors(stay, T, roles)
        others = _differ(stay, there)
        gone.append(_ids(stay)[others])
        if others.any():
            turned.append(pick_factors(there, others)._replace(ids=None))
    if not sum(map(len, gone)):
        gone, turned = _one_anew(alone)
    changes = Changes()
    if (ids := np.concatenate([np.empty(0, np.int64), *gone])).size:
        changes.remove_factors(ids.tolist())
    places = moving_variables(part)
    if fixed := [key for group in places if group.fixed for key in group.keys.tolist()]:
        changes.free(*fixed)
    changes.place([g._replace(values=roles.moved(g.kind, g.keys, _values(g), T)) for g in places], carry=True)
    return changes, turned


def _one_anew(alone: Sequence[tuple[Factors, np.ndarray]]) -> tuple[list[I64], list[Factors]]:
    """The oldest factor of the part, which goes and comes again.

    Of two clients that attach one part at the same time the second names a factor that is gone: it is refused, where
    the candidates would be in the map twice.
    """
    oldest = min((g for g, _ in alone if g.keys.size), key=lambda g: int(_ids(g).min()), default=None)
    if oldest is None:
        return [], []
    row = _ids(oldest) == _ids(oldest).min()
    return [_ids(oldest)[row]], [pick_factors(oldest, row)._replace(ids=None)]


def _differ(one: Factors, other: Factors) -> np.ndarray:
    """(n,), of which factors anything measured, or its certainty, differs."""
    return (one.measured != other.measured).any(axis=1) | (one.information != other.information).any(axis=1)


def _ids(group: Factors) -> I64:
    if group.ids is None:
        raise CannotMerge(f"the map's {group.kind} factors came without ids; wanted a whole graph")
    return group.ids


def _values(group: Variables) -> F64:
    if group.values is None:
        raise CannotMerge(f"the map's {group.kind} variables came without values; wanted a whole graph")
    return group.values
