"""One map into another: what the other has, under new names and in this one's frame, as one insert.

    T_a_b   where the frame of b, the map that is merged, lies in that of a, the map that it goes into

It is only as good as an anchor, and only where the solver begins: what holds b to a afterwards are the anchors, as
factors among others.  So what b knows of its own frame is worth nothing in a, and is left out where it is only what a
map has to begin with: one fixed pose, or one prior of a pose.  More says something of the world, which is wrong in a.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from factorbus.client.arguments import of_type
from factorbus.client.draft import Draft, batch_of
from factorbus.client.frames import (
    SPACES,
    compose,
    difference,
    inverse,
)
from factorbus.client.roles import Roles, roles_of, split_mounts
from factorbus.client.transform_factors import transform_factors
from factorbus.client.transform_linear import are_relative
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS, name_of_kind
from factorbus.proto.messages import Accepted, Batch, Estimate, Factors, MapGraph, Variables
from factorbus.proto.problems import Problem
from factorbus.proto.roles import pick_factors, pick_variables
from factorbus.proto.symbols import MAX_INDEX, format_symbol, symbol

ABSOLUTE = ("refuse", "leave_out", "keep")
_PRIORS = ("prior_se2", "prior_se3")
_BETWEEN = ("between_se2", "between_se3")
_SHOWN = 5
_HELD_TWICE = (
    "the other map says where it is in its own frame more than once ({}), which is wrong in this one; "
    'nothing was merged. absolute="leave_out" merges it without them, "keep" as it is, if both have one frame'
)


class KeyCollision(Problem):
    """Two variables would have one key."""

    code = "key_collision"

    def __init__(self, keys: I64, where: str) -> None:
        super().__init__(
            f"{keys_named(keys)} would be there twice: {where}; nothing was merged. Give the variables of the other "
            'map letters of their own, such as letters={"x": "y"}'
        )


class NoAnchor(Problem):
    """Nothing says how one map's frame lies in the other's."""

    code = "no_anchor"

    def __init__(self, why: str) -> None:
        super().__init__(
            f"{why}; nothing was merged. Give a relative pose between a pose of each map, the other's under its new "
            'key (anchors=Draft().between_se2("x5", "y8", ...)), or frame= with sigmas='
        )


class AbsoluteFactors(Problem):
    """The map that is to be merged knows more of its own frame than where it begins."""

    code = "absolute_factors"

    def __init__(self, held: Mapping[str, int], said: str = _HELD_TWICE) -> None:
        super().__init__(said.format(", ".join(f"{count} {kind}" for kind, count in held.items())), **held)


class CannotMerge(Problem):
    """The one map does not fit into the other."""

    code = "cannot_merge"


@dataclass(frozen=True, slots=True)
class Fitted:
    """What is to be inserted so that one map is in the other.

    frame: T_a_b that its values were moved by, (3,) or (7,).  left_out: how many of each kind are not in it ("fixed":
    variables that are now estimated).  anchors: how many factors at the end of the batch hold it.
    """

    batch: Batch
    frame: F64
    left_out: Mapping[str, int] = field(default_factory=dict)
    anchors: int = 0


@dataclass(frozen=True, slots=True)
class Merged:
    """What came of a merge.  accepted: as of any insert; fitted: what was inserted."""

    accepted: Accepted
    fitted: Fitted


def as_trusted(batch: Batch) -> Batch:
    """The same, none of which is tested by a map that tests its loop closures: a person sends it."""
    return batch._replace(factors=tuple(group._replace(trusted=True) for group in batch.factors))


def fit_into(
    here: Estimate,
    other: MapGraph,
    *,
    anchors: Batch | Draft | None = None,
    frame: ArrayLike | None = None,
    sigmas: ArrayLike | None = None,
    letters: Mapping[str, str] | None = None,
    absolute: str = "refuse",
) -> Fitted:
    """What brings the map `other` into the one that is as `here`; see `factorbus.client.Map.merge`.

    Raises KeyCollision, NoAnchor, AbsoluteFactors, CannotMerge, BadSymbol, BadOption.
    """
    if not isinstance(absolute, str) or absolute not in ABSOLUTE:
        raise CannotMerge(f"absolute is {absolute!r}; wanted one of {', '.join(ABSOLUTE)}")
    named = of_type("letters", {} if letters is None else letters, Mapping, 'a mapping of letters, such as {"x": "y"}')
    given = Batch() if anchors is None else batch_of("anchors", anchors)
    size = _size_of(other.batch)
    renamed = with_letters(other.batch, named)
    roles = roles_of(renamed)
    of_robots, renamed = split_mounts(renamed)
    _check_keys(here, _together(of_robots, renamed))
    _check_ends(given, here, _together(of_robots, renamed))
    kept, left_out = (renamed, {}) if absolute == "keep" else _relative(renamed, absolute, roles)
    if absolute == "keep":
        T = np.array([0.0] * size if size == 3 else [0.0] * 6 + [1.0])
        return Fitted(_together(of_robots, _together(kept, given)), T, {}, given.factor_count)
    places = _without(renamed.variables, roles.frames)
    T = _frame(here, places, given, frame, size)
    if not given.factor_count:
        given = _tie(here, places, T, sigmas).batch()
    moved = Batch(
        tuple(g._replace(values=roles.moved(g.kind, g.keys, _values(g), T)) for g in kept.variables),
        tuple(transform_factors(g, T, roles) for g in kept.factors),
    )
    return Fitted(_together(of_robots, _together(moved, given)), T, left_out, given.factor_count)


def _size_of(batch: Batch) -> int:
    """Numbers of a pose in the one space that the map is in."""
    placed = [group for group in batch.variables if group.keys.size and not VARIABLE_KINDS[group.kind].is_vector]
    sizes = {SPACES.get(group.kind, 0) for group in placed}
    if len(sizes) != 1 or 0 in sizes:
        kinds = ", ".join(sorted({group.kind for group in batch.variables})) or "nothing"
        if batch.variables and not placed:
            raise CannotMerge(
                f"the other map has {kinds} alone, which have no frame that could be brought into this one's; "
                "insert its graph().batch as it is, if its keys are free here"
            )
        raise CannotMerge(f"the other map has {kinds}; wanted variables of the plane alone, or of space")
    return sizes.pop()


def with_letters(batch: Batch, letters: Mapping[str, str]) -> Batch:
    """With other letters, and without ids, which are those of another map.  Raises CannotMerge, BadSymbol."""
    codes = {_code(old): _code(new) for old, new in letters.items()}
    _check_letters(batch, codes)

    def rename(keys: I64) -> I64:
        made = keys.copy()
        for old, new in codes.items():
            made[keys >> 56 == old] = (keys & MAX_INDEX)[keys >> 56 == old] | new << 56
        return made

    return Batch(
        tuple(group._replace(keys=rename(group.keys)) for group in batch.variables),
        tuple(group._replace(keys=rename(group.keys), ids=None) for group in batch.factors),
    )


def _check_letters(batch: Batch, codes: Mapping[int, int]) -> None:
    """A letter that no variable has would be a slip that goes by unseen.  Raises CannotMerge."""
    there = set((_keys(batch.variables) >> 56).tolist())
    for code in codes:
        if code not in there:
            have = ", ".join(sorted(_called(each) for each in there))
            raise CannotMerge(
                f"letters renames {_called(code)}, and the other map has no such variables; it has {have}"
            )


def _called(code: int) -> str:
    return repr(chr(code)) if chr(code).isalpha() else "keys without a letter"


def _code(letter: str) -> int:
    return symbol(letter, 0) >> 56


def _check_keys(here: Estimate, renamed: Batch) -> None:
    keys = _keys(renamed.variables)
    names, counts = np.unique(keys, return_counts=True)
    if (counts > 1).any():
        raise KeyCollision(names[counts > 1], "letters gives two variables of the other map the same one")
    common = np.intersect1d(names, _keys(here.variables))
    if common.size:
        raise KeyCollision(common, "both maps have such variables")


def _check_ends(anchors: Batch, here: Estimate, renamed: Batch) -> None:
    """Every end of an anchor is in one of the maps, or comes with the anchors.  Raises NoAnchor."""
    known = _keys((*here.variables, *renamed.variables, *anchors.variables))
    ends = [group.keys.reshape(-1) for group in anchors.factors]
    missing = np.setdiff1d(np.concatenate([np.empty(0, np.int64), *ends]), known)
    if missing.size:
        raise NoAnchor(f"the anchors name {keys_named(missing)}, which neither this map has nor the other as renamed")


def _relative(batch: Batch, absolute: str, roles: Roles) -> tuple[Batch, dict[str, int]]:
    """Without what is said of the map's own frame, and how many of each kind that were.  Raises AbsoluteFactors."""
    held: dict[str, int] = {}
    fixed = sum(group.keys.size for group in batch.variables if group.fixed)
    if fixed:
        held["fixed"] = fixed
    factors = []
    for group in batch.factors:
        stays = hold_in_any_frame(group, roles)
        if not stays.all():
            name = name_of_kind(group.kind)
            held[name] = held.get(name, 0) + int((~stays).sum())
        if stays.any():
            factors.append(pick_factors(group, stays))
    if absolute == "refuse" and not is_gauge(batch, held):
        raise AbsoluteFactors(held)
    return Batch(tuple(group._replace(fixed=False) for group in batch.variables), tuple(factors)), held


def hold_in_any_frame(group: Factors, roles: Roles) -> np.ndarray:
    """(n,), which say nothing of where in the map's frame their variables are."""
    if FACTOR_KINDS[group.kind].is_linear:
        return are_relative(group, roles)
    return np.full(len(group.keys), not FACTOR_KINDS[group.kind].is_absolute)


def is_gauge(batch: Batch, held: Mapping[str, int]) -> bool:
    """Whether it is no more than what a map that knows nothing of the world needs to begin with."""
    if sum(held.values()) > 1:
        return False
    poses = all(group.kind in ("se2", "se3") for group in batch.variables if group.fixed)
    return poses and all(kind in ("fixed", *_PRIORS) for kind in held)


def _frame(here: Estimate, there: Sequence[Variables], anchors: Batch, frame: ArrayLike | None, size: int) -> F64:
    """T_a_b: as given, or by the relative pose among the anchors that agrees best with all of them."""
    if frame is not None:
        given = np.array(frame, np.float64)
        if given.shape != (size,) or not np.isfinite(given).all() or (size == 7 and not np.any(given[3:])):
            raise CannotMerge(
                f"frame is {given.tolist()}; wanted {size} numbers, where the other map's origin is in this one"
            )
        return given if size == 3 else np.array([*given[:3], *given[3:] / np.linalg.norm(given[3:])])
    links = _links(_poses(here.variables), _poses(there), anchors)
    if not links:
        raise NoAnchor("there is no relative pose between a pose of this map and one of the other")
    return min((T for T, *_ in links), key=lambda T: sum(_off(T, *rest) for _, *rest in links))


def _links(here: Mapping[int, F64], there: Mapping[int, F64], anchors: Batch) -> list[tuple[F64, F64, F64, F64, F64]]:
    """Of every relative pose from a to b or back: T_a_b by it alone, x_a, x_b, what is measured, Ω."""
    links = []
    for group in anchors.factors:
        for keys, measured, triangle in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            if group.kind not in _BETWEEN:
                continue
            for (a, b), z in ((keys, measured), (keys[::-1], inverse(measured))):
                if a in here and b in there and here[a].size == there[b].size == z.size:
                    T = compose(compose(here[a], z[None])[0], inverse(there[b])[None])[0]
                    links.append((T, here[a], there[b], z, _full(triangle, z.size)))
    return links


def _off(T: F64, a: F64, b: F64, z: F64, omega: F64) -> float:
    """√(rᵀΩr) of one relative pose, were T_a_b this: a root, so that one false anchor does not outvote all others."""
    r = difference(z, compose(inverse(a), compose(T, b[None]))[0])
    return float(np.sqrt(max(r @ omega @ r, 0.0)))


def _full(triangle: F64, size: int) -> F64:
    dim = 3 if size == 3 else 6
    full = np.zeros((dim, dim))
    full[np.triu_indices(dim)] = triangle
    return full + np.triu(full, 1).T


def _tie(here: Estimate, there: Sequence[Variables], T: F64, sigmas: ArrayLike | None) -> Draft:
    """A relative pose that says what T says: between the poses that hold the two maps, or their first."""
    if sigmas is None:
        raise NoAnchor("frame says where the other map is, and nothing says how certain that is")
    (a, x_a), (b, x_b) = _reference(here.variables, T.size), _reference(there, T.size)
    z = compose(inverse(x_a), compose(T, x_b[None]))[0]
    return Draft().factor("between_se2" if z.size == 3 else "between_se3", (a, b), z, sigmas=sigmas)


def _reference(groups: Sequence[Variables], size: int) -> tuple[int, F64]:
    for group in sorted(groups, key=lambda group: not group.fixed):
        if group.kind in ("se2", "se3") and group.keys.size and SPACES[group.kind] == size:
            first = int(np.argmin(group.keys))
            return int(group.keys[first]), _values(group)[first]
    raise NoAnchor("one of the maps has no pose in the space of the other's")


def _without(groups: Sequence[Variables], keys: I64) -> list[Variables]:
    return [pick_variables(group, ~np.isin(group.keys, keys)) for group in groups]


def _together(batch: Batch, anchors: Batch) -> Batch:
    return Batch((*batch.variables, *anchors.variables), (*batch.factors, *anchors.factors))


def _poses(groups: Sequence[Variables]) -> dict[int, F64]:
    poses = [group for group in groups if group.kind in ("se2", "se3")]
    return {int(key): row for g in poses for key, row in zip(g.keys, _values(g), strict=True)}


def _keys(groups: Sequence[Variables]) -> I64:
    return np.concatenate([np.empty(0, np.int64), *(group.keys for group in groups)])


def _values(group: Variables) -> F64:
    if group.values is None:
        raise CannotMerge(f"the other map's {group.kind} variables came without values; wanted a whole graph")
    return group.values


def keys_named(keys: I64) -> str:
    """The first of them, and how many more there are."""
    more = f" and {keys.size - _SHOWN} more" if keys.size > _SHOWN else ""
    return ", ".join(format_symbol(int(key)) for key in keys[:_SHOWN]) + more
