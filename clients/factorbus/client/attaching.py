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
from factorbus.client.arguments import of_type
from factorbus.client.changes import Changes
from factorbus.client.draft import Draft, batch_of
from factorbus.client.map import Map
from factorbus.client.merging import (
    AbsoluteFactors,
    CannotMerge,
    as_trusted,
    hold_in_any_frame,
    is_gauge,
)
from factorbus.client.roles import Roles, roles_of, split_mounts
from factorbus.client.transform_factors import transform_factors
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import VARIABLE_KINDS, name_of_kind
from factorbus.proto.messages import Accepted, Batch, Factors, Variables
from factorbus.proto.roles import mounts_of, pick_factors, pick_variables
from factorbus.proto.symbols import format_symbol, symbol

_ABSOLUTE = ("refuse", "leave_out")
_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Attached:
    """What came of it.

    accepted: the answer to the insert that attached it; None: the candidates do not say where it is yet, or say two
    things (`alignment.verdict`), and nothing has changed.  left_out: how many of each kind of what held it are gone
    ("fixed": variables that are now estimated).
    """

    alignment: Alignment
    accepted: Accepted | None = None
    left_out: Mapping[str, int] = field(default_factory=dict)


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

    The part is to be a part: a factor between it and the rest is refused (CannotMerge).  Mounts, and numbers such as a
    bias or a scale, may be shared.  What robots insert meanwhile goes along with what it hangs on.
    Raises AbsoluteFactors, CannotMerge, BadSymbol, BadOption: nothing was sent.  Raises Refused (the map is as it was),
    Unavailable.
    """
    of_type("here", here, Map, "a Map")
    if absolute not in _ABSOLUTE:
        raise CannotMerge(f"absolute is {absolute!r}; wanted one of {', '.join(_ABSOLUTE)}")
    given = batch_of("candidates", candidates)
    kind = kind_of_candidates(given)
    # 1. The part, and that nothing joins it to the rest.
    graph = here.graph(timeout_s).batch
    part, rest = _split(graph, _codes(letters))
    # 2. What holds it in its own frame.
    roles = roles_of(graph)
    alone = [(group, ~hold_in_any_frame(group, roles)) for group in part.factors]
    held = _held(part, alone)
    if absolute == "refuse" and not is_gauge(part, held):
        raise AbsoluteFactors(held)
    # 3. Where it lies.
    found = align_sides(side_of(here, rest, kind), side_of(here, part.variables, kind), given, timeout_s)
    if found.verdict != ALIGNED or found.frame is None:
        return Attached(found)
    # 4. One insert.
    changes, turned = _changes(part, alone, roles, found.frame)
    anchors = found.anchors()
    batch = Batch((), (*turned, *anchors.factors))
    sent = as_trusted(batch) if here.closures == "test" else batch
    return Attached(found, here.insert(sent, changes=changes, settle=settle, timeout_s=timeout_s), held)


def _codes(letters: str) -> set[int]:
    """Raises CannotMerge, BadSymbol."""
    if not of_type("letters", letters, str, 'letters, such as "b"'):
        raise CannotMerge('letters is empty; wanted those of the part that is to be attached, such as "b"')
    return {symbol(letter, 0) >> 56 for letter in letters}


def _split(graph: Batch, codes: set[int]) -> tuple[Batch, tuple[Variables, ...]]:
    """The part with these letters, and the places of the rest.  Raises CannotMerge."""
    wanted = list(codes)
    names = np.concatenate([np.empty(0, np.int64), *(group.keys for group in graph.variables)])
    inside = np.isin(names >> 56, wanted)
    for which, missing in ((inside, "with these letters"), (~inside, "with other letters")):
        if not which.any():
            have = ", ".join(sorted({format_symbol(key)[:1] for key in names.tolist()}))
            raise CannotMerge(f"the map has no variable {missing}; its letters are {have or 'none'}")
    # Mounts and plain numbers are in no frame, so that both parts may have them.
    aside = np.concatenate([mounts_of(graph), *(g.keys for g in graph.variables if VARIABLE_KINDS[g.kind].is_vector)])
    aside = np.setdiff1d(aside, roles_of(graph).axes)
    factors: list[Factors] = []
    for group in graph.factors:
        of_part, nowhere = np.isin(group.keys >> 56, wanted), np.isin(group.keys, aside)
        some = np.asarray((of_part & ~nowhere).any(axis=1))
        both = some & np.asarray((~of_part & ~nowhere).any(axis=1))
        if both.any():
            raise _joined(group, both)
        if some.any():
            factors.append(pick_factors(group, some))
    groups = [(group, np.isin(group.keys >> 56, wanted)) for group in graph.variables]
    part = tuple(pick_variables(group, chosen) for group, chosen in groups if chosen.any())
    rest = tuple(pick_variables(group, ~chosen) for group, chosen in groups if not chosen.all())
    return Batch(part, tuple(factors)), rest


def _joined(group: Factors, which: np.ndarray) -> CannotMerge:
    """The error that names some of the factors that join the part to the rest."""
    pairs = [f"({', '.join(map(format_symbol, keys))})" for keys in group.keys[which][:_SHOWN].tolist()]
    more = f" and {int(which.sum()) - _SHOWN} more" if which.sum() > _SHOWN else ""
    return CannotMerge(
        f"the part is joined to the rest already, by {name_of_kind(group.kind)} {', '.join(pairs)}{more}; wanted a "
        "part that has no factor with the rest: keep candidates out of the map, and give them to `attach`"
    )


def _moving(part: Batch) -> list[Variables]:
    """All but mounts and plain numbers, which are the same in every frame."""
    axes = roles_of(part).axes
    groups = [
        (g, np.isin(g.keys, axes) | (not VARIABLE_KINDS[g.kind].is_vector)) for g in split_mounts(part)[1].variables
    ]
    return [pick_variables(group, chosen) for group, chosen in groups if chosen.any()]


def _held(part: Batch, alone: Sequence[tuple[Factors, np.ndarray]]) -> dict[str, int]:
    """How many of each kind hold the part in its own frame."""
    fixed = sum(group.keys.size for group in _moving(part) if group.fixed)
    held = {"fixed": fixed} if fixed else {}
    for group, which in alone:
        if which.any():
            name = name_of_kind(group.kind)
            held[name] = held.get(name, 0) + int(which.sum())
    return held


def _changes(
    part: Batch, alone: Sequence[tuple[Factors, np.ndarray]], roles: Roles, T: F64
) -> tuple[Changes, list[Factors]]:
    """What brings the part to where it lies, and factors of it that have other numbers there."""
    gone, turned = list[I64](), list[Factors]()
    for group, which in alone:
        stay = pick_factors(group, ~which)
        there = transform_factors(stay, T, roles)
        others = _differ(stay, there)
        gone += [_ids(group)[which], _ids(stay)[others]]
        if others.any():
            turned.append(pick_factors(there, others)._replace(ids=None))
    changes = Changes()
    if (ids := np.concatenate([np.empty(0, np.int64), *gone])).size:
        changes.remove_factors(ids.tolist())
    places = _moving(part)
    if fixed := [key for group in places if group.fixed for key in group.keys.tolist()]:
        changes.free(*fixed)
    changes.place([g._replace(values=roles.moved(g.kind, g.keys, _values(g), T)) for g in places], carry=True)
    return changes, turned


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
