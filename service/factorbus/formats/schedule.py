"""When each variable of a graph enters a replay: as early as the order of the poses and the factors allow."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from factorbus.formats.errors import FormatError
from factorbus.formats.parallax import composed_odometry, delay_points
from factorbus.formats.ranging import RANGES, Ranges, refuse_unvalued
from factorbus.proto.arrays import F64, I64
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import format_symbol, symbol_parts
from factorbus.wording import counted

POSES = ("se2", "se3")


@dataclass(frozen=True, slots=True)
class Roster:
    """All variables of a batch in one list.

    keys, is_pose, fixed, valued (N,); rank (N,): the place of a pose in the order of the poses, -1 for points;
    pose_at (P,): the pose of each rank; before (N,): the pose before a pose, -1 for none (`_ordered`); ends: per group
    of factors the rows (m, arity) of its variables; since: the rank (m,) of the first pose that finds each there.
    """

    keys: I64
    is_pose: np.ndarray
    fixed: np.ndarray
    valued: np.ndarray
    rank: I64
    pose_at: I64
    before: I64
    ends: tuple[I64, ...]
    since: tuple[I64, ...]


@dataclass(frozen=True, slots=True)
class Schedule:
    """entry (N,): the rank of the pose with which each variable enters.  root: the row of a pose to be fixed as the
    origin of the map, or -1.  given: rows of variables that no composition reaches, so that they need their value."""

    entry: I64
    root: int
    given: I64


def roster(file: str, batch: Batch, times: Sequence[I64] = ()) -> Roster:
    """The variables of `batch`.  Raises FormatError when a factor names a variable that it does not have.

    times: of the factors of each group, where they have some of their own.
    """
    empty = np.empty(0, np.int64)
    keys = np.concatenate([empty, *(group.keys for group in batch.variables)])
    is_pose = _spread(batch, [group.kind in POSES for group in batch.variables])
    order = np.argsort(keys, kind="stable")
    pose_at, before = _ordered(batch, keys, is_pose)
    rank = np.full(len(keys), -1, np.int64)
    rank[pose_at] = np.arange(len(pose_at))
    ends = []
    for group in batch.factors:
        at = np.minimum(np.searchsorted(keys[order], group.keys), max(len(keys) - 1, 0))
        if len(keys) == 0 or (keys[order][at] != group.keys).any():
            raise FormatError(file, None, f"{group.kind} of a variable that is not in the graph", "all its variables")
        ends.append(order[at])
    return Roster(
        keys=keys,
        is_pose=is_pose,
        fixed=_spread(batch, [group.fixed for group in batch.variables]),
        valued=_spread(batch, [group.values is not None for group in batch.variables]),
        rank=rank,
        pose_at=pose_at,
        before=before,
        ends=tuple(ends),
        since=_since(batch, ends, times, pose_at),
    )


def _ordered(batch: Batch, keys: I64, is_pose: np.ndarray) -> tuple[I64, I64]:
    """(poses in their order, the pose before each variable that is one, else -1).

    The order is that of the keys.  Where all poses have a time stamp it is that of time, and the pose before a pose is
    one of the same robot, the letter of its key.
    """
    poses = np.flatnonzero(is_pose)
    poses = poses[np.argsort(keys[poses], kind="stable")]
    chains = [poses]
    stamps = np.concatenate([np.empty(0, np.int64), *(_stamps(group) for group in batch.variables)])
    if len(poses) and (stamps[poses] != NO_STAMP).all():
        poses = poses[np.argsort(stamps[poses], kind="stable")]
        letters = np.array([symbol_parts(key)[0] for key in keys[poses].tolist()])
        chains = [poses[letters == letter] for letter in np.unique(letters)]
    before = np.full(len(keys), -1, np.int64)
    for chain in chains:
        before[chain[1:]] = chain[:-1]
    return poses, before


def _since(batch: Batch, ends: Sequence[I64], times: Sequence[I64], pose_at: I64) -> tuple[I64, ...]:
    """The rank of the first pose that finds each factor there: 0 but of late factors between two poses.

    Those are of a time after that of both poses, as loop closures are of robots that could not talk before.  They come
    with the first pose of their time or later, or with the last one.
    """
    stamps = np.concatenate([np.empty(0, np.int64), *(_stamps(group) for group in batch.variables)])
    since = [np.zeros(len(rows), np.int64) for rows in ends]
    if (stamps[pose_at] == NO_STAMP).any():  # then the order is not that of time
        return tuple(since)
    for group, rows, at, first in zip(batch.factors, ends, times, since, strict=False):
        if all(end in POSES for end in FACTOR_KINDS[group.kind].connects):
            late = at > stamps[rows].max(axis=1)
            first[late] = np.minimum(np.searchsorted(stamps[pose_at], at[late]), len(pose_at) - 1)
    return tuple(since)


def _stamps(group: Variables) -> I64:
    return np.full(len(group.keys), NO_STAMP) if group.stamps is None else group.stamps


def scheduled(file: str, batch: Batch, names: Roster, use_values: bool = False) -> Schedule:
    """When every variable enters.  Raises FormatError when the graph is in parts or has no beginning.

    use_values: poses are at the values of the file, not where composed odometry has them.

    A pose enters at its own turn (`_ordered`) if an edge joins it to a pose that is in, else with the first pose that
    makes such a chain.  Where nothing is fixed and no pose has a prior, the first pose is the root; otherwise the
    replay begins at those poses.  A point enters with the first pose that sees it, one that only bearings see with the
    pose whose bearing tells where it is (`parallax`), and what only ranges tell of once they determine it (`ranging`).
    """
    if not len(names.pose_at):
        raise FormatError(file, None, "no pose", "at least one pose")
    seeds = _seeds(batch, names)
    root = -1
    if not (names.fixed.any() or seeds.any()):
        root = int(names.pose_at[0])
        seeds[root] = True
    seeds |= names.fixed & names.is_pose
    _refuse_unknown_fixed(file, names)
    ranges = Ranges(batch, names.ends, names.fixed)
    refuse_unvalued(file, names.keys, ranges, names.valued)
    entry, given = (None, np.empty(0, np.int64)) if ranges else _in_turn(batch, names, seeds)
    if entry is None:
        entry, given = _flooded(batch, names, seeds, ranges)
    _enter_points(batch, names, entry, ranges)
    if any(group.kind == "bearing_se2" for group in batch.factors):
        known = _known_poses(batch, names, root, given, use_values)
        poses = composed_odometry(batch, names.ends, names.rank, entry, known)
        delay_points(batch, names.ends, names.rank, names.fixed, poses, entry)
    if (entry < 0).any():
        raise _unreached(file, names, entry, ranges)
    return Schedule(entry, root, given)


def _spread(batch: Batch, flags: Sequence[bool]) -> np.ndarray:
    """One flag for each group of variables, as one for each variable."""
    return np.repeat(np.array(flags, bool), [len(group.keys) for group in batch.variables])


def _seeds(batch: Batch, names: Roster) -> np.ndarray:
    """Poses that have a prior."""
    seeds = np.zeros(len(names.keys), bool)
    for group, ends in zip(batch.factors, names.ends, strict=True):
        if group.kind in ("prior_se2", "prior_se3"):
            seeds[ends] = True
    return seeds


def _refuse_unknown_fixed(file: str, names: Roster) -> None:
    """A fixed variable needs its value; only the very first pose may do without, as the origin."""
    lost = names.fixed & ~names.valued
    lost[names.pose_at[0]] = False
    if lost.any():
        shown = format_symbol(int(names.keys[np.argmax(lost)]))
        raise FormatError(file, None, f"{shown} is fixed but has no value", f"a vertex line for {shown}")


def _pairs(batch: Batch, names: Roster, points: bool) -> I64:
    """(m, 3) of all factors between two poses, or a pose and a point, but for ranges: both rows, and since when."""
    chosen = [
        np.column_stack([ends, since])
        for group, ends, since in zip(batch.factors, names.ends, names.since, strict=True)
        if group.kind not in RANGES
        and ends.shape[1] == 2
        and (FACTOR_KINDS[group.kind].connects[1] not in POSES) == points
    ]
    return np.concatenate([np.empty((0, 3), np.int64), *chosen])


def _in_turn(batch: Batch, names: Roster, seeds: np.ndarray) -> tuple[I64 | None, I64]:
    """Entries when every pose can enter at its own turn: each is a seed or has an edge to an earlier one."""
    pairs = _pairs(batch, names, points=False)
    later = names.rank[pairs[:, :2]].max(axis=1, initial=-1)
    joined = seeds[names.pose_at].copy()
    joined[later[pairs[:, 2] <= later]] = True
    if not seeds[names.pose_at[0]] or not joined.all():
        return None, np.empty(0, np.int64)
    return names.rank.copy(), np.empty(0, np.int64)


def _flooded(batch: Batch, names: Roster, seeds: np.ndarray, ranges: Ranges) -> tuple[I64, I64]:
    """Entries of poses when some must wait, pose by pose, and of the points that only ranges see.

    A pose is reached over an edge from a pose that is in, once the edge is there.  When there is none, a pose that sees
    a point that is in, or a fixed one, is let in at the value its vertex line gives, if it has one; and so is a body
    that ranges determine.
    """
    edges, observations = _neighbours(_pairs(batch, names, False)), _neighbours(_pairs(batch, names, True))
    late = _late(_pairs(batch, names, False))
    entry = np.full(len(names.keys), -1, np.int64)
    known = set(np.flatnonzero(names.fixed & ~names.is_pose).tolist())
    given: list[int] = []

    def is_in(row: int) -> bool:
        return entry[row] >= 0 or row in known

    def is_next(row: int, turn: int) -> bool:
        return entry[row] < 0 and names.rank[row] <= turn

    def enter(turn: int, first: int) -> list[int]:
        """Let `first` in and all poses that had been waiting for it; what may be let in now."""
        waiting, observed = [first], []
        while waiting:
            pose = waiting.pop()
            if entry[pose] >= 0:
                continue
            entry[pose] = turn
            observed += ranges.of(pose)
            waiting += [other for other, since in edges[pose] if is_next(other, turn) and since <= turn]
            for point, _ in observations[pose]:
                if point not in known:
                    known.add(point)
                    observed += [*(seen for seen, _ in observations[point]), *ranges.of(point)]
        return observed

    def body_of(row: int, turn: int) -> list[int]:
        """A point alone, or the poses so far that odometry joins to a pose."""
        found, waiting = {row}, [row]
        while waiting and names.is_pose[row]:
            new = {other for other, since in edges[waiting.pop()] if is_next(other, turn) and since <= turn} - found
            found |= new
            waiting += new
        return sorted(found)

    for turn, pose in enumerate(names.pose_at.tolist()):
        candidates = [pose]
        if seeds[pose] or any(entry[other] >= 0 and since <= turn for other, since in edges[pose]):
            candidates = enter(turn, pose)
        for one, other in late[turn]:
            if (entry[one] < 0) != (entry[other] < 0):
                candidates += enter(turn, one if entry[one] < 0 else other)
        while candidates:
            row = candidates.pop()
            if not (is_next(row, turn) and names.valued[row] and (names.is_pose[row] or ranges.lone[row])):
                continue
            sees = names.is_pose[row] and any(point in known for point, _ in observations[row])
            if sees or (ranges and ranges.determine(body_of(row, turn), is_in)):
                given.append(row)
                candidates += enter(turn, row)
    _enter_undetermined(names, ranges, entry, given)
    return entry, np.array(given, np.int64)


def _enter_undetermined(names: Roster, ranges: Ranges, entry: I64, given: list[int]) -> None:
    """Let in each point that ranges never determine, with the last pose that sees it: the solver says what it lacks."""
    for point in np.flatnonzero(ranges.lone & (entry < 0)).tolist():
        seen = [entry[pose] for pose in ranges.of(point) if entry[pose] >= 0]
        if seen:
            entry[point] = max(seen)
            given.append(point)


def _known_poses(batch: Batch, names: Roster, root: int, given: I64, use_values: bool) -> dict[int, F64]:
    """Values of the 2D poses that do not come from composed odometry, by row."""
    values, first = {}, 0
    for group in batch.variables:
        if group.kind == "se2" and group.values is not None:
            values |= dict(enumerate(group.values, first))
        first += len(group.keys)
    chosen = {root, *given.tolist(), *np.flatnonzero(names.fixed).tolist()}
    known = {row: value for row, value in values.items() if use_values or row in chosen}
    for group, ends in zip(batch.factors, names.ends, strict=True):
        if group.kind == "prior_se2":
            known |= {
                row: value for row, value in zip(ends[:, 0].tolist(), group.measured, strict=True) if row not in known
            }
    if names.is_pose.any():
        known.setdefault(int(names.pose_at[0]) if root < 0 else root, np.zeros(3))
    return known


def _neighbours(pairs: I64) -> dict[int, list[tuple[int, int]]]:
    """By variable (the other, since when)."""
    found: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for one, other, since in pairs.tolist():
        found[one].append((other, since))
        found[other].append((one, since))
    return found


def _late(pairs: I64) -> dict[int, list[tuple[int, int]]]:
    """By turn the pairs of poses that are joined from then on."""
    found: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for one, other, since in pairs[pairs[:, 2] > 0].tolist():
        found[since].append((one, other))
    return found


def _enter_points(batch: Batch, names: Roster, entry: I64, ranges: Ranges) -> None:
    """Entries of points that not only ranges see: with the first pose that does; of unseen ones that are known, at the
    start.
    """
    observations = _pairs(batch, names, points=True)
    first = np.full(len(entry), np.iinfo(np.int64).max)
    seen = observations[entry[observations[:, 0]] >= 0]
    np.minimum.at(first, seen[:, 1], entry[seen[:, 0]])
    points = ~names.is_pose & ~ranges.lone
    known = names.fixed.copy()
    for group, ends in zip(batch.factors, names.ends, strict=True):
        if group.kind in ("prior_point2", "prior_point3"):
            known[ends] = True
    unseen = first == np.iinfo(np.int64).max
    start = int(entry[names.pose_at][entry[names.pose_at] >= 0].min(initial=0))
    entry[points] = np.where(unseen, np.where(known, start, -1), first)[points]


def _unreached(file: str, names: Roster, entry: I64, ranges: Ranges) -> FormatError:
    """The error that names what cannot be joined to the rest."""
    parts = _parts(len(entry), [ends for ends in names.ends if ends.shape[1] == 2])
    if len(parts) > 1:
        shown = "; ".join(_shown_part(names, part) for part in parts[:4]) + ("; ..." if len(parts) > 4 else "")
        return FormatError(
            file,
            None,
            f"the graph is in {len(parts)} parts that no factor joins: {shown}",
            "one part, or a fixed vertex with a value (FIX) or a prior in each",
        )
    lost = format_symbol(int(names.keys[np.argmax(entry < 0)]))
    return FormatError(
        file,
        None,
        f"{lost} is joined to the rest only through {'ranges that do not determine it' if ranges else 'points'}",
        f"an edge to another pose, or a vertex line for {lost}{' and more ranges' if ranges else ''}",
    )


def _parts(count: int, ends: list[I64]) -> list[I64]:
    """Rows of the variables of each connected part, the largest first."""
    label = np.arange(count)
    pairs = np.concatenate([np.empty((0, 2), np.int64), *ends])
    while True:  # every pass gives both ends of each factor the lower label, then follows labels to their own label
        low = np.minimum(label[pairs[:, 0]], label[pairs[:, 1]])
        new = label.copy()
        np.minimum.at(new, label[pairs[:, 0]], low)
        np.minimum.at(new, label[pairs[:, 1]], low)
        while (new[new] != new).any():
            new = new[new]
        new = new[label]
        if (new == label).all():
            break
        label = new
    parts = [np.flatnonzero(label == name) for name in np.unique(label)]
    return sorted(parts, key=len, reverse=True)


def _shown_part(names: Roster, part: I64) -> str:
    keys = names.keys[part[np.lexsort((names.keys[part], ~names.is_pose[part]))]]  # poses first
    ends = [format_symbol(int(key)) for key in (keys[0], keys[-1])]
    return ends[0] if len(part) == 1 else f"{ends[0]} .. {ends[1]} ({counted(len(part), 'variable')})"
