"""Another map into this one by pairs of poses that are one place: its frame, the anchors, and the insert.

One pair: the two are one pose, heading included.  Several: they are one place each, and how the maps are turned
against each other is what brings these places together best (Kabsch, of positions alone).
"""

import string
from collections.abc import Iterable, Mapping

import numpy as np

from factorbus.client import Draft
from factorbus.client.frames import compose, inverse
from factorbus.client.merging import CannotMerge, Fitted, fit_into
from factorbus.gateway.edit_requests import EditRequest
from factorbus.gateway.steps import EditPlan, EditStep
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Estimate, MapGraph, Variables
from factorbus.proto.problems import BadShape
from factorbus.proto.symbols import format_symbol, symbol, symbol_parts
from factorbus.wording import counted

_POSES = {"se2": 3, "se3": 7}
_FLAT = 1e-3  # of the second singular value to the first: below, places are on a line, and any turn about it will do


def plan_merge(request: EditRequest, graph: MapGraph, other: MapGraph) -> tuple[EditPlan, Fitted, Mapping[str, str]]:
    """The plan, what is inserted, and the letters of the other's keys, old to new.

    Raises CannotMerge, KeyCollision, NoAnchor, AbsoluteFactors, BadShape.
    """
    pairs, sigmas = request.fields["pairs"], request.fields["sigmas"]
    here = _poses_of(graph, [a for a, _ in pairs], "this map")
    there = _poses_of(other, [b for _, b in pairs], "the other")
    if here.shape != there.shape:
        raise CannotMerge("one map is in the plane and the other in space; nothing was merged. Merge maps of one kind")
    dim = 3 if here.shape[1] == 3 else 6
    if len(sigmas) != dim:
        raise BadShape("merge: sigmas", len(sigmas), f"{dim}, metres and radians of each pair")
    frame = frame_of_pairs(here, there)
    letters = free_letters(graph.batch.variables, other.batch.variables)
    anchors = Draft()
    for (a, b), x_a, x_b in zip(pairs, here, there, strict=True):
        z = compose(inverse(x_a), compose(frame, x_b[None]))[0]
        z[: 2 if dim == 3 else 3] = 0.0  # they are one place
        anchors.factor("between_se2" if dim == 3 else "between_se3", (a, _renamed(b, letters)), z, sigmas=sigmas)
    estimate = Estimate(graph.epoch, graph.revision, graph.batch.variables)
    fitted = fit_into(
        estimate, other, anchors=anchors, frame=frame, letters=letters, absolute=request.fields["absolute"]
    )
    keys = tuple(int(key) for group in fitted.batch.variables for key in group.keys)
    what = f"merged map {request.fields['other']} by {counted(len(pairs), 'pair')}"
    plan = EditPlan(what, EditStep(insert=fitted.batch), lambda new: EditStep(remove=tuple(new), forget=keys))
    return plan, fitted, letters


def frame_of_pairs(here: F64, there: F64) -> F64:
    """T_a_b that brings poses `there` (n, 3) or (n, 7) to `here`.  Raises CannotMerge where they do not say it."""
    if len(here) == 1:
        return compose(here[0], inverse(there[0])[None])[0]
    size = 2 if here.shape[1] == 3 else 3
    a, b = here[:, :size], there[:, :size]
    u, singular, vt = np.linalg.svd((b - b.mean(axis=0)).T @ (a - a.mean(axis=0)))
    if singular[0] < 1e-12 or (size == 3 and singular[1] < _FLAT * singular[0]):
        wanted = "two pairs at two places" if size == 2 else "three pairs that are not on a line"
        raise CannotMerge(
            f"the {len(here)} pairs do not say how the maps are turned; nothing was merged. Give {wanted}, or one pair "
            "alone, which is taken for one pose"
        )
    sign = np.ones(size)
    sign[-1] = np.sign(np.linalg.det(vt.T @ u.T))
    turn = vt.T @ np.diag(sign) @ u.T
    moved = a.mean(axis=0) - turn @ b.mean(axis=0)
    if size == 2:
        return np.array([*moved, np.arctan2(turn[1, 0], turn[0, 0])])
    return np.array([*moved, *_quaternion(turn)])


def free_letters(here: Iterable[Variables], other: Iterable[Variables]) -> dict[str, str]:
    """A letter that neither map has for each of the other's that both have.  Raises CannotMerge: there is none left."""
    mine, theirs = _letters(here), _letters(other)
    free = iter(each for each in string.ascii_lowercase + string.ascii_uppercase if each not in mine | theirs)
    chosen = {}
    for letter in sorted(mine & theirs):
        new = next(free, None)
        if new is None:
            raise CannotMerge(
                f"no letter is left for the other map's {letter!r}; nothing was merged. Use `factorbus change merge`"
            )
        chosen[letter] = new
    return chosen


def _letters(groups: Iterable[Variables]) -> set[str]:
    """The letter of each key with one, and "" of those without."""
    codes = np.unique(np.concatenate([np.empty(0, np.int64), *(group.keys >> 56 for group in groups)]))
    return {symbol_parts(int(code) << 56)[0] for code in codes}


def _renamed(key: int, letters: Mapping[str, str]) -> int:
    letter, index = symbol_parts(key)
    return symbol(letters[letter], index) if letter in letters else key


def _poses_of(graph: MapGraph, keys: list[int], where: str) -> F64:
    """Poses of the kind that the first key has.  Raises CannotMerge."""
    known = {
        int(key): row
        for group in graph.batch.variables
        if group.kind in _POSES and group.values is not None
        for key, row in zip(group.keys, group.values, strict=True)
    }
    for key in keys:
        if key not in known:
            raise CannotMerge(f"{format_symbol(key)} is no pose of {where}; nothing was merged. Pair poses (se2, se3)")
    poses = [known[key] for key in keys]
    if len({pose.size for pose in poses}) > 1:
        raise CannotMerge(
            f"the pairs have poses of {where} in the plane and in space; nothing was merged. Pair one kind"
        )
    return np.array(poses)


def _quaternion(turn: F64) -> F64:
    """x y z w of a rotation matrix, by the largest of the four, so that nothing is divided by a small number."""
    four = np.array(
        [
            1 + turn[0, 0] - turn[1, 1] - turn[2, 2],
            1 - turn[0, 0] + turn[1, 1] - turn[2, 2],
            1 - turn[0, 0] - turn[1, 1] + turn[2, 2],
            1 + np.trace(turn),
        ]
    )
    n = int(np.argmax(four))
    xy, xz, yz = turn[0, 1] + turn[1, 0], turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1]
    x, y, z = turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    rows = ([four[0], xy, xz, x], [xy, four[1], yz, y], [xz, yz, four[2], z], [x, y, z, four[3]])
    return np.array(rows[n]) / (2 * np.sqrt(four[n]))
