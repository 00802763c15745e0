"""When a point that only bearings see enters a replay: once two of them tell where it is.

A bearing alone does not place a point, and two nearly parallel ones place it anywhere: an estimate that begins there
runs off.  So such a point waits, and its bearings with it, for a pose whose ray meets an earlier one in front of both
robots, at an angle of at least `_LEAST_ANGLE` and `_SIGMAS` standard deviations of the bearings.  Poses are where
composed odometry has them, or the file: of poses close in time, which see a point one after the other, that is about
as good as an estimate.  A point that never gets so far enters with the last pose that sees it.  The solver then puts it
where the rays meet at its own estimate.
"""

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from factorbus.formats.rotations import compose_poses, inverse_poses
from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch

_LEAST_ANGLE = 0.1  # radians
_SIGMAS = 6.0
_PLACING = ("landmark_se2", "landmark_se3", "bearing_range_se2", "prior_point2", "prior_point3")


def lone_bearings(batch: Batch) -> I64:
    """Keys of the points that nothing but bearings from a single pose see: nothing is known of where they are."""
    poses: dict[int, set[int]] = defaultdict(set)
    known = {key for group in batch.variables if group.fixed for key in group.keys.tolist()}
    for group in batch.factors:
        if group.kind == "bearing_se2":
            for pose, point in group.keys.tolist():
                poses[point].add(pose)
        else:
            known.update(group.keys.ravel().tolist())
    return np.array([point for point, seen in poses.items() if len(seen) < 2 and point not in known], np.int64)


def delay_points(batch: Batch, ends: tuple[I64, ...], rank: I64, fixed: np.ndarray, poses: F64, entry: I64) -> None:
    """Set in `entry` when each point that only bearings see enters, which its first observation has set before.

    in      ends: per group of factors the rows of its variables   rank (N,): of poses, -1 for points   fixed (N,)
            poses (N, 3): x y theta of 2D poses, NaN where unknown
    in/out  entry (N,): the rank of the pose with which each variable enters
    """
    placing = np.full(len(entry), np.iinfo(np.int64).max)
    rays: dict[int, list[tuple[int, int, float, float]]] = defaultdict(list)
    for group, rows in zip(batch.factors, ends, strict=True):
        if group.kind in _PLACING:
            np.minimum.at(placing, rows[:, -1], entry[rows[:, 0]])
        if group.kind == "bearing_se2":
            sigmas = 1.0 / np.sqrt(group.information[:, 0])
            for (pose, point), angle, sigma in zip(rows.tolist(), group.measured[:, 0], sigmas, strict=True):
                if not fixed[point] and entry[pose] >= 0:
                    rays[point].append((int(entry[pose]), pose, float(angle), float(sigma)))
    for point, seen in rays.items():
        seen.sort(key=lambda ray: (ray[0], rank[ray[1]]))
        entry[point] = min(_met(seen, poses), int(placing[point]))


def composed_odometry(batch: Batch, ends: tuple[I64, ...], rank: I64, entry: I64, known: Mapping[int, F64]) -> F64:
    """Where the 2D poses are by composed odometry, each from the pose nearest in time that was in before: (N, 3).

    known: values of poses that have one, by row.
    """
    edges: dict[int, list[tuple[int, F64]]] = defaultdict(list)
    for group, rows in zip(batch.factors, ends, strict=True):
        if group.kind == "between_se2":
            for (i, j), z, back in zip(rows.tolist(), group.measured, inverse_poses(group.measured), strict=True):
                edges[j].append((i, z))
                edges[i].append((j, back))
    poses = np.full((len(rank), 3), np.nan)
    waiting: list[int] = []
    order = np.lexsort((rank, entry))
    for row in order[(rank[order] >= 0) & (entry[order] >= 0)].tolist():
        waiting.append(row)
        while placed := [pose for pose in waiting if _place(pose, poses, edges[pose], known, rank)]:
            waiting = [pose for pose in waiting if pose not in placed]
    return poses


def _place(pose: int, poses: F64, edges: list[tuple[int, F64]], known: Mapping[int, F64], rank: I64) -> bool:
    """Give `pose` its place, if it has one or a neighbour that has."""
    if pose in known:
        poses[pose] = known[pose]
        return True
    placed = [(other, at) for at, (other, _) in enumerate(edges) if not np.isnan(poses[other, 0])]
    near = [(abs(int(rank[other] - rank[pose])), at) for other, at in placed]
    if not near:
        return False
    other, z = edges[min(near)[1]]
    poses[pose] = compose_poses(poses[None, other], z[None])[0]
    return True


def _met(seen: list[tuple[int, int, float, float]], poses: F64) -> int:
    """The entry of the first pose whose ray meets an earlier one well; of the last pose where none does."""
    places = poses[[pose for _, pose, _, _ in seen]]
    angles = places[:, 2] + np.array([angle for _, _, angle, _ in seen])
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    sigmas = np.array([sigma for _, _, _, sigma in seen])
    for k in range(1, len(seen)):
        apart = places[:k, :2] - places[k, :2]
        cross = ways[k, 0] * ways[:k, 1] - ways[k, 1] * ways[:k, 0]  # sine of the angle at which they meet
        with np.errstate(divide="ignore", invalid="ignore"):
            mine = (apart[:, 0] * ways[:k, 1] - apart[:, 1] * ways[:k, 0]) / cross
            theirs = (apart[:, 0] * ways[k, 1] - apart[:, 1] * ways[k, 0]) / cross
        enough = np.maximum(_LEAST_ANGLE, _SIGMAS * np.hypot(sigmas[k], sigmas[:k]))
        if ((np.abs(cross) >= np.sin(np.minimum(enough, 0.5))) & (mine > 0) & (theirs > 0)).any():
            return seen[k][0]
    return seen[-1][0]
