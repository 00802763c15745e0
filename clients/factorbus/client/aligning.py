"""Where another map lies in this one, found out from relative poses of which many may be false.

    candidates = Draft().between_se2("a10", "c0", (1, 0, 0), sigmas=(0.1, 0.1, 0.05))  # and thirty more
    found = align(hall, yard, candidates, letters={"x": "c"})
    print(found)                                # 12 of 31 agree, σ 0.04 m and 0.3°; no other set of more than 2 does
    hall.merge(yard, anchors=found.anchors(), letters={"x": "c"}, settle=True)

How that is judged stands in `alignment`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorbus.client.alignment import (
    ALIGNED,
    AMBIGUOUS,
    FEWEST,
    MOST_BY_CHANCE,
    TOO_FEW,
    CandidatePoses,
    Judgement,
    adjoint_of,
    gap_between,
    judge,
)
from factorbus.client.arguments import of_type
from factorbus.client.call_order import call_order
from factorbus.client.draft import Draft, batch_of
from factorbus.client.frames import matrix_of_pose, pose_of_matrix
from factorbus.client.map import Map
from factorbus.client.merging import CannotMerge, with_letters
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import name_of_kind
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import Problem
from factorbus.proto.roles import pick_factors
from factorbus.proto.symbols import format_symbol
from factorbus.wording import counted

MOST_CANDIDATES = 500
_LEAST_INFORMATION = 1e-8  # σ 10 km: it says nothing
_BETWEEN = {"between_se2": "se2", "between_se3": "se3"}


class NotAligned(Problem):
    """The candidates do not say where one map lies in the other."""

    code = "not_aligned"


class AmbiguousAlignment(NotAligned):
    """They say two things."""

    code = "ambiguous_alignment"


@dataclass(frozen=True, slots=True)
class Alignment:
    """What candidates say of where another map lies.

    verdict: "aligned", "ambiguous" or "too_few" (that agree).  frame: T_a_b, x y θ or x y z qx qy qz qw, by the largest
    set; None where no two candidates agree.  reference: the candidate in its midst.  covariance (d, d): of the other's
    pose of that candidate as seen from this map's, in its tangent space, metres and radians.
    agree, rival: which candidates the largest set has, and the largest one of the others, by their numbers, which are
    in the order in which they were drafted.  by_chance: how many sets like the largest are expected among false ones.
    numbers: of each of `candidates`, which a draft has by loss.
    """

    verdict: str
    frame: F64 | None
    reference: int | None
    covariance: F64 | None
    agree: I64
    rival: I64
    by_chance: float
    candidates: Batch
    numbers: I64
    said: str

    def __str__(self) -> str:
        return self.said

    def anchors(self) -> Batch:
        """The candidates that agree, for `Map.merge`.  Raises NotAligned, AmbiguousAlignment."""
        if self.verdict == AMBIGUOUS:
            raise AmbiguousAlignment(
                f"{self.said}; nothing has changed. Give candidates at more places, or of one set alone as anchors"
            )
        if self.verdict != ALIGNED:
            raise NotAligned(f"{self.said}; nothing has changed. Give more candidates, at places far from each other")
        agrees = np.isin(self.numbers, self.agree)
        return Batch((), tuple(pick_factors(group, agrees[rows]) for group, rows in _numbered(self.candidates)))


def align(
    here: Map,
    other: Map,
    candidates: Batch | Draft,
    *,
    letters: Mapping[str, str] | None = None,
    timeout_s: float | None = None,
) -> Alignment:
    """Find where the map `other` lies in `here`, of relative poses between both, of which many may be false.

    candidates: `between_se2` or `between_se3` between a pose of `here` and one of `other` under its new key, 500 at
    most; their certainty is that of a right one.  letters: new ones of the other's keys, as for `merge`.
    Nothing is changed.  Poses and covariances are asked for one after the other: let nobody insert meanwhile.
    Raises CannotMerge (no such candidates), BadOption, BadSymbol, Refused, Unavailable.
    """
    of_type("here", here, Map, "a Map")
    of_type("other", other, Map, "a Map")
    given = batch_of("candidates", candidates)
    named = of_type("letters", letters or {}, Mapping, 'a mapping of letters, such as {"x": "y"}')
    kind = kind_of_candidates(given)
    sides = (
        Side(here, _poses(here.ask_estimate(timeout_s=timeout_s).variables, {}, kind)),
        Side(other, _poses(other.ask_estimate(timeout_s=timeout_s).variables, named, kind)),
    )
    return align_sides(*sides, given, call_order(candidates), timeout_s)


class Side(NamedTuple):
    """Poses in one frame.  poses: by the key that candidates have, the key in `map`, and the pose as a matrix."""

    map: Map
    poses: Mapping[int, tuple[int, F64]]


def side_of(of: Map, variables: Sequence[Variables], kind: str) -> Side:
    """Poses of a kind, under the keys that they have."""
    return Side(of, _poses(variables, {}, kind))


def align_sides(here: Side, there: Side, given: Batch, order: Sequence[int], timeout_s: float | None) -> Alignment:
    """Where the frame of `there` lies in that of `here`; order: see `call_order`.  Raises as `align` does."""
    kind = kind_of_candidates(given)
    ends = [_ends(kind, pair, here.poses, there.poses) for group in given.factors for pair in group.keys.tolist()]
    of_a, of_b = [here.poses[a] for a, *_ in ends], [there.poses[b] for _, b, _ in ends]
    z, noise = _measured(given, kind, np.array([turned for *_, turned in ends]))
    kept = _first_of_each(ends, z, noise)
    known = CandidatePoses(
        np.array([of_a[k][1] for k in kept]),
        np.array([of_b[k][1] for k in kept]),
        z[kept],
        noise[kept],
        _joint(here.map, [of_a[k][0] for k in kept], timeout_s),
        _joint(there.map, [of_b[k][0] for k in kept], timeout_s),
        np.array([ends[k][:2] for k in kept]),
    )
    return _alignment(judge(known), given, np.array(kept), np.argsort(order))


def kind_of_candidates(given: Batch) -> str:
    """The kind of pose that the candidates are between.  Raises CannotMerge."""
    kinds = {name_of_kind(group.kind) for group in given.factors if group.keys.size}
    wanted = "relative poses alone, all between_se2 or all between_se3"
    if given.variable_count or len(kinds) != 1 or not kinds <= set(_BETWEEN):
        have = ", ".join([*sorted(kinds), *(g.kind for g in given.variables)]) or "nothing"
        raise CannotMerge(f"the candidates are {have}; wanted {wanted}")
    if given.factor_count > MOST_CANDIDATES:
        raise CannotMerge(f"there are {given.factor_count} candidates; wanted {MOST_CANDIDATES} at most, the best ones")
    return _BETWEEN[kinds.pop()]


def _poses(variables: Sequence[Variables], letters: Mapping[str, str], kind: str) -> dict[int, tuple[int, F64]]:
    """By new key: its own key, and the pose as a matrix."""
    batch = Batch(tuple(variables))
    renamed = with_letters(batch, letters) if letters else batch
    found: dict[int, tuple[int, F64]] = {}
    for group, new in zip(batch.variables, renamed.variables, strict=True):
        if group.kind == kind and group.values is not None:
            rows = zip(new.keys.tolist(), group.keys.tolist(), group.values, strict=True)
            found |= {key: (own, matrix_of_pose(value)) for key, own, value in rows}
    return found


def _ends(
    kind: str, pair: list[int], here: Mapping[int, tuple[int, F64]], there: Mapping[int, tuple[int, F64]]
) -> tuple[int, int, bool]:
    """The pose here, the one there, and whether the candidate names that one first.  Raises CannotMerge."""
    a, b = pair
    if a in here and b in there and (a in there or b in here):
        named = f"{format_symbol(a)} and {format_symbol(b)}"
        raise CannotMerge(
            f'both maps have {named}; give the other\'s letters of their own, such as letters={{"x": "y"}}'
        )
    if a in here and b in there:
        return a, b, False
    if b in here and a in there:
        return b, a, True
    missing = " and ".join(format_symbol(key) for key in pair if key not in here and key not in there)
    why = f"{missing}, which neither map has as a pose of kind {kind}" if missing else "two poses of one map"
    raise CannotMerge(
        f"a candidate names {why} ({format_symbol(a)}, {format_symbol(b)}); wanted a pose of each map, the other's "
        "under its new key"
    )


def _measured(given: Batch, kind: str, turned: np.ndarray) -> tuple[F64, F64]:
    """Of each candidate the pose of the other map as seen from this one's, as a matrix, and its covariance."""
    d = 3 if kind == "se2" else 6
    z = np.concatenate([np.array([matrix_of_pose(row) for row in group.measured]) for group in given.factors])
    upper = np.concatenate([group.information for group in given.factors])
    omega = np.zeros((len(z), d, d))
    rows, columns = np.triu_indices(d)
    omega[:, rows, columns] = omega[:, columns, rows] = upper
    _check_certain(given, z, omega)
    covariance: F64 = np.asarray(np.linalg.inv(omega), np.float64)
    if kind == "se3":  # the residual of a rotation is half its angle
        radians = np.array([1.0] * 3 + [2.0] * 3)
        covariance *= radians[:, None] * radians
    back = adjoint_of(z[turned])
    covariance[turned] = back @ covariance[turned] @ back.swapaxes(1, 2)
    z[turned] = np.linalg.inv(z[turned])
    return z, covariance


def _first_of_each(ends: list[tuple[int, int, bool]], z: F64, noise: F64) -> list[int]:
    """Which candidates are not a copy of one before: the same measurement twice is no more certain than once."""
    first: dict[tuple[int, int, bytes, bytes], int] = {}
    for k, (a, b, _) in enumerate(ends):
        first.setdefault((a, b, z[k].tobytes(), noise[k].tobytes()), k)
    return list(first.values())


def _check_certain(given: Batch, z: F64, omega: F64) -> None:
    """Raises CannotMerge: a candidate is no number, or says nothing of a direction."""
    finite = np.isfinite(z).all(axis=(1, 2)) & np.isfinite(omega).all(axis=(1, 2))
    known = np.zeros(len(z), bool)
    known[finite] = np.linalg.eigvalsh(omega[finite])[:, 0] > _LEAST_INFORMATION
    if not known.all():
        pairs = np.concatenate([group.keys for group in given.factors])
        named = ", ".join(map(format_symbol, pairs[int(known.argmin())].tolist()))
        seen = f"the candidate between {named} is no relative pose with a certainty in every direction"
        least = f"σ below {_LEAST_INFORMATION**-0.5:g} m and rad in all"
        raise CannotMerge(f"{seen} (its information is not positive definite, or not finite); wanted {least}")


def _joint(of: Map, keys: list[int], timeout_s: float | None) -> F64:
    """The joint covariance of poses, in which one that comes twice stands twice."""
    unique, where = np.unique(keys, return_inverse=True)
    whole = of.uncertainty.joint(unique.tolist(), timeout_s=timeout_s)
    d = len(whole) // unique.size
    rows = (where[:, None] * d + np.arange(d)).ravel()
    return whole[np.ix_(rows, rows)]


def _alignment(found: Judgement, given: Batch, kept: I64, numbers: I64) -> Alignment:
    best, rival = found.best, found.rival
    nobody = np.empty(0, np.int64)
    said, copies = _sentence(found, kept.size), given.factor_count - kept.size
    if copies:
        said += f"; {counted(copies, 'copy', 'copies')} of others left out"
    return Alignment(
        found.verdict,
        None if best is None else pose_of_matrix(best.T),
        None if best is None else int(numbers[kept[best.reference]]),
        None if best is None else best.covariance,
        nobody if best is None else np.sort(numbers[kept[best.members]]),
        nobody if rival is None else np.sort(numbers[kept[rival.members]]),
        math.inf if best is None else best.by_chance,
        given,
        numbers,
        said,
    )


def _sentence(found: Judgement, count: int) -> str:
    """The verdict with its numbers."""
    best, rival = found.best, found.rival
    if best is None:
        return f"no two of {count} candidates agree" if count > 1 else "1 candidate, and none that it could agree with"
    place, turn = best.sigmas()
    said = f"{best.members.size} of {count} agree, σ {place:.2g} m and {math.degrees(turn):.2g}°"
    if found.verdict == TOO_FEW:
        said += f": too few; {best.by_chance:.2g} such sets are expected of false candidates alone, wanted at most "
        said += f"{MOST_BY_CHANCE:g}, at {FEWEST} places or more"
    if rival is None:
        return f"{said}; no two of the others do"
    apart, turned = gap_between(best.T, rival.T)
    where = f"{_two_digits(apart)} m and {_two_digits(math.degrees(turned))}° from there"
    if found.verdict == AMBIGUOUS:
        return f"{said}; ambiguous with a second set of {rival.members.size}, {where}"
    return f"{said}; the largest set of the others has {rival.members.size}, {where}"


def _two_digits(number: float) -> str:
    """Without an exponent where it is large: 0.012, 1.2, 12, 123."""
    return f"{number:.0f}" if number >= 99.5 else f"{number:.2g}"


def _numbered(batch: Batch) -> list[tuple[Factors, I64]]:
    """Each group with the numbers of its candidates."""
    ends = np.cumsum([0, *(len(group.keys) for group in batch.factors)])
    return [(g, np.arange(a, b)) for g, a, b in zip(batch.factors, ends, ends[1:], strict=False)]
