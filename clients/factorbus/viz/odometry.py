"""Where a robot would be without a map: poses composed from odometry alone, as batches come by."""

import math
from collections.abc import Callable, Mapping

import numpy as np

from factorbus.proto.arrays import I64
from factorbus.proto.messages import Batch, Variables

Pose = tuple[float, ...]


class Odometry:
    """Dead reckoning: each pose from the first edge that reaches it, later edges unheard.

    Poses with a value keep it while they are the first; the map's origin is taken where nothing is fixed.
    """

    def __init__(self) -> None:
        self._poses: dict[str, dict[int, Pose]] = {"se2": {}, "se3": {}}

    def add(self, batch: Batch) -> None:
        """Reckon the new poses of `batch`, in the order of its edges."""
        for kind, known in self._poses.items():
            for group in batch.variables:
                if group.kind == kind and group.values is not None and (group.fixed or not known):
                    known.update(zip(group.keys.tolist(), map(tuple, group.values.tolist()), strict=True))
            for group in batch.factors:
                if group.kind == f"between_{kind}":
                    self._reckon(known, _ALGEBRA[kind], group.keys.tolist(), list(map(tuple, group.measured.tolist())))

    def variables(self) -> tuple[Variables, ...]:
        """The poses reckoned so far, per kind, in the order in which they were."""
        return tuple(
            Variables(kind, np.array(list(known)), np.array(list(known.values())))
            for kind, known in self._poses.items()
            if known
        )

    @staticmethod
    def _reckon(known: dict[int, Pose], algebra: "_Algebra", pairs: list[list[int]], measured: list[Pose]) -> None:
        compose, inverse, origin = algebra
        if not known and pairs:
            known[min(pairs[0])] = origin
        waiting = list(zip(pairs, measured, strict=True))
        while waiting:
            later = []
            for (i, j), z in waiting:
                if i in known and j not in known:
                    known[j] = compose(known[i], z)
                elif j in known and i not in known:
                    known[i] = compose(known[j], inverse(z))
                elif i not in known:
                    later.append(((i, j), z))
            if len(later) == len(waiting):
                return
            waiting = later


def loops_of(batch: Batch) -> I64:
    """Keys (m, 2) of the edges between poses that do not follow each other.

    batch: a whole graph, or a step of a replay with its odometry edge.
    """
    pairs = [group.keys for group in batch.factors if group.kind in ("between_se2", "between_se3", "between_sim3")]
    keys = np.concatenate([np.empty((0, 2), np.int64), *pairs])
    poses = [group.keys for group in batch.variables if group.kind in ("se2", "se3", "sim3")]
    order = np.unique(np.concatenate([keys.ravel(), *poses]))  # points may have taken numbers between two poses
    ranks = np.searchsorted(order, keys)
    return keys[np.abs(ranks[:, 0] - ranks[:, 1]) > 1]


def _compose_se2(a: Pose, b: Pose) -> Pose:
    c, s = math.cos(a[2]), math.sin(a[2])
    return a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], a[2] + b[2]


def _inverse_se2(a: Pose) -> Pose:
    c, s = math.cos(a[2]), math.sin(a[2])
    return -c * a[0] - s * a[1], s * a[0] - c * a[1], -a[2]


def _turn(q: Pose, v: Pose) -> Pose:
    """v (3) turned by q (qx qy qz qw)."""
    x, y, z, w = q
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )


def _compose_se3(a: Pose, b: Pose) -> Pose:
    (x, y, z), (px, py, pz, pw), (qx, qy, qz, qw) = _turn(a[3:], b[:3]), a[3:], b[3:]
    quat = (
        pw * qx + qw * px + py * qz - pz * qy,
        pw * qy + qw * py + pz * qx - px * qz,
        pw * qz + qw * pz + px * qy - py * qx,
        pw * qw - px * qx - py * qy - pz * qz,
    )
    norm = math.sqrt(sum(part * part for part in quat))
    return a[0] + x, a[1] + y, a[2] + z, quat[0] / norm, quat[1] / norm, quat[2] / norm, quat[3] / norm


def _inverse_se3(a: Pose) -> Pose:
    back = (-a[3], -a[4], -a[5], a[6])
    x, y, z = _turn(back, a[:3])
    return -x, -y, -z, *back


_Algebra = tuple[Callable[[Pose, Pose], Pose], Callable[[Pose], Pose], Pose]
_ALGEBRA: Mapping[str, _Algebra] = {
    "se2": (_compose_se2, _inverse_se2, (0.0, 0.0, 0.0)),
    "se3": (_compose_se3, _inverse_se3, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
}
