"""What the factors of a graph say of places and rotations, in one form for the plane and for space.  MATH §12.1.

A node is the map (0) or a variable (its index + 1).  The map's frame is that of a pose at the origin which is known, so
a prior is a relative pose from there.
"""

from dataclasses import dataclass, replace

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import ends_of_rows, losses_of
from factorbus.solver.graph.factors import FACTOR_KIND_OF_CODE, FactorKind
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.rotation_matrices import matrices_of_angles, matrices_of_quaternions

MAP = 0


@dataclass(frozen=True, slots=True)
class PoseSpace:
    """The plane or space: its dimension, and its kinds of variables and factors."""

    dim: int
    pose: int
    point: int
    prior: int
    prior_point: int
    between: int
    landmark: int
    position: int
    bearing: int
    between_mount: int
    between_scale: int


PLANE = PoseSpace(
    2, at.SE2, at.POINT2, at.PRIOR_SE2, at.PRIOR_POINT2, at.BETWEEN_SE2, at.LANDMARK_SE2, at.POSITION_SE2,
    at.BEARING_SE2, at.FACTOR_CODES["between_se2_mount"], at.FACTOR_CODES["between_se2_scale"],
)  # fmt: skip
SPACE = PoseSpace(
    3, at.SE3, at.POINT3, at.PRIOR_SE3, at.PRIOR_POINT3, at.BETWEEN_SE3, at.LANDMARK_SE3, at.POSITION_SE3,
    at.BEARING_SE3, at.FACTOR_CODES["between_se3_mount"], at.FACTOR_CODES["between_se3_scale"],
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Relations:
    """Nodes b seen from nodes a: of each a rotation and a translation, with what they weigh.

    a, b (m,)   R (m, d, d): of b in a   t (m, d): of b in a, metres
    turn (m,): information of a rotation, one number, 1/rad²; 0: there is none
    t_information (m, d, d): information of t in the frame of a, 1/m²
    couple (m, d, ρ): of t with the rotation's residual
    lever (m, d): a point of b that t is the place of, in b
    row (m,): of the factor   loss (m,), scale (m,): its loss
    """

    a: I64
    b: I64
    R: F64
    t: F64
    turn: F64
    t_information: F64
    couple: F64
    lever: F64
    row: I64
    loss: I64
    scale: F64

    def __len__(self) -> int:
        return len(self.a)

    def where(self, chosen: np.ndarray) -> "Relations":
        """Some of them."""
        return Relations(*(getattr(self, name)[chosen] for name in self.__slots__))

    def weighed(self, weights: F64) -> "Relations":
        """The same, the information of each times its weight."""
        wide = weights[:, None, None]
        return replace(
            self,
            turn=self.turn * weights,
            t_information=self.t_information * wide,
            couple=self.couple * wide,
        )

    def joined(self, other: "Relations") -> "Relations":
        """These and others behind them."""
        return Relations(*(np.concatenate([getattr(self, name), getattr(other, name)]) for name in self.__slots__))


@dataclass(frozen=True, slots=True)
class Directions:
    """R_b s = g: directions s that poses b see where the map has g.  weight (m,)."""

    b: I64
    seen: F64
    there: F64
    weight: F64

    def where(self, chosen: np.ndarray) -> "Directions":
        """Some of them."""
        return Directions(*(getattr(self, name)[chosen] for name in self.__slots__))


def relations_of(graph: FactorGraph, space: PoseSpace) -> tuple[Relations, Directions]:
    """All that the factors of a graph say of poses and points in one space."""
    return Relations(*map(np.concatenate, zip(*_parts(graph, space), strict=True))), _directions(graph, space)


def _parts(graph: FactorGraph, space: PoseSpace) -> list[tuple[np.ndarray, ...]]:
    parts = [_poses(graph, space, kind) for kind in (space.between, space.between_scale, space.prior)]
    parts += [_points(graph, space, space.landmark), _points(graph, space, space.prior_point)]
    parts += [_between_sensors(graph, space), _positions(graph, space), _bearings(graph, space)]
    parts += [_linear(graph, space, rows) for rows in _linear_factors(graph, space)]
    if space.dim == 2:
        parts += [_bearing_ranges(graph), _headings(graph)]
    return parts


def _rows(graph: FactorGraph, kind: int) -> tuple[I64, I64, F64, F64]:
    """(rows, fac of them, measured, information matrices) of the factors of one kind."""
    declared = FACTOR_KIND_OF_CODE[kind]
    fac = graph.fac[: graph.counts[at.FACTORS]]
    rows = np.flatnonzero(fac[:, at.F_KIND] == kind)
    picked = fac[rows]
    numbers = graph.payload[picked[:, at.F_AT, None] + np.arange(declared.size + declared.triangle)]
    i, j = np.triu_indices(declared.dim)
    information = np.empty((rows.size, declared.dim, declared.dim))
    information[:, i, j] = information[:, j, i] = numbers[:, declared.size :]
    return rows, picked, numbers[:, : declared.size], information


def _losses(graph: FactorGraph, rows: I64, fac: I64) -> tuple[I64, F64]:
    """The codes of the losses, and their scales."""
    loss = losses_of(fac)
    scale, robust = np.ones(len(fac)), np.flatnonzero(loss != at.NO_LOSS)
    scale[robust] = graph.payload[fac[robust, at.F_AT] + sum(graph.sizes_of(rows[robust]))]
    return loss, scale


def _made(
    graph: FactorGraph,
    rows: I64,
    fac: I64,
    a: I64,
    b: I64,
    t: F64,
    t_information: F64,
    **more: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """A part of `Relations`; what is not given is nothing."""
    m, d = t.shape
    nothing = {
        "R": np.zeros((m, d, d)), "turn": np.zeros(m), "couple": np.zeros((m, d, 1 if d == 2 else 3)),
        "lever": np.zeros((m, d)),
    }  # fmt: skip
    got = nothing | more
    loss, scale = _losses(graph, rows, fac)
    return a, b, got["R"], t, got["turn"], t_information, got["couple"], got["lever"], rows, loss, scale


def poses_apart(numbers: F64) -> tuple[F64, F64]:
    """(rotation matrices, translations) of poses as they are stored, (n, 3) or (n, 7)."""
    if numbers.shape[1] == 3:
        return matrices_of_angles(numbers[:, 2]), numbers[:, :2]
    return matrices_of_quaternions(numbers[:, 3:]), numbers[:, :3]


def _poses(graph: FactorGraph, space: PoseSpace, kind: int) -> tuple[np.ndarray, ...]:
    rows, fac, measured, information = _rows(graph, kind)
    (R, t), d = poses_apart(measured), space.dim
    b = fac[:, at.F_I if kind == space.prior else at.F_J] + 1
    a = np.zeros(rows.size, np.int64) if kind == space.prior else fac[:, at.F_I] + 1
    if kind == space.between_scale:  # the scale as it is now
        t = t * _value(graph, graph.fac[rows + 1, at.F_J], 1)
    t_information = R @ information[:, :d, :d] @ R.transpose(0, 2, 1)
    turn, couple = _turn(information, d), R @ information[:, :d, d:]
    return _made(graph, rows, fac, a, b, t, t_information, R=R, turn=turn, couple=couple)


def _between_sensors(graph: FactorGraph, space: PoseSpace) -> tuple[np.ndarray, ...]:
    """Robots from what a sensor has measured of its own way, the mount as it is now: m z m⁻¹."""
    rows, fac, measured, information = _rows(graph, space.between_mount)
    (R, t), d = poses_apart(measured), space.dim
    mounts = _value(graph, graph.fac[rows + 1, at.F_J], 3 if d == 2 else 7)
    Q, q = poses_apart(mounts)
    back = Q.transpose(0, 2, 1)
    moved, turned = Q @ R, Q @ R @ back
    t = (Q @ t[:, :, None] - turned @ q[:, :, None])[:, :, 0] + q
    t_information = moved @ information[:, :d, :d] @ moved.transpose(0, 2, 1)
    a, b = fac[:, at.F_I] + 1, fac[:, at.F_J] + 1
    turn = _turn(information, d)
    return _made(graph, rows, fac, a, b, t, t_information, R=turned, turn=turn)


def _turn(information: F64, d: int) -> F64:
    """What a rotation weighs whatever the translation: the mean of the diagonal of the Schur complement, per rad²."""
    across = information[:, d:, :d]
    alone = information[:, d:, d:] - across @ np.linalg.solve(information[:, :d, :d], across.transpose(0, 2, 1))
    mean = np.trace(alone, axis1=1, axis2=2) / alone.shape[1]
    # A quaternion's vector part is half the angle.
    return np.maximum(mean, 1e-12 * np.trace(information[:, d:, d:], axis1=1, axis2=2)) * (1.0 if d == 2 else 0.25)


def _points(graph: FactorGraph, space: PoseSpace, kind: int) -> tuple[np.ndarray, ...]:
    rows, fac, measured, information = _rows(graph, kind)
    seen = kind == space.landmark
    a = fac[:, at.F_I] + 1 if seen else np.zeros(rows.size, np.int64)
    b = fac[:, at.F_J if seen else at.F_I] + 1
    return _made(graph, rows, fac, a, b, measured, information)


def _bearing_ranges(graph: FactorGraph) -> tuple[np.ndarray, ...]:
    rows, fac, measured, information = _rows(graph, at.BEARING_RANGE_SE2)
    bearing, distance = measured.T
    u = np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
    g = np.stack([np.stack([-u[:, 1], u[:, 0]], axis=1) / distance[:, None], u], axis=1)
    t_information = g.transpose(0, 2, 1) @ information @ g
    a, b = fac[:, at.F_I] + 1, fac[:, at.F_J] + 1
    return _made(graph, rows, fac, a, b, distance[:, None] * u, t_information)


def _bearings(graph: FactorGraph, space: PoseSpace) -> tuple[np.ndarray, ...]:
    """Points on a line: at the distance that they have now, and free to move along it."""
    rows, fac, measured, information = _rows(graph, space.bearing)
    u = np.stack([np.cos(measured[:, 0]), np.sin(measured[:, 0])], axis=1) if space.dim == 2 else measured
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    away = _value(graph, fac[:, at.F_J], space.dim) - _value(graph, fac[:, at.F_I], space.dim)
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-3)
    across = np.eye(space.dim) - u[:, :, None] * u[:, None, :]
    weight = np.trace(information, axis1=1, axis2=2) / information.shape[1] / distance**2
    a, b = fac[:, at.F_I] + 1, fac[:, at.F_J] + 1
    t_information = weight[:, None, None] * across
    return _made(graph, rows, fac, a, b, distance[:, None] * u, t_information)


def _value(graph: FactorGraph, variables: I64, numbers: int) -> F64:
    """The leading numbers of the present values."""
    return graph.values[graph.var[variables, at.V_AT, None] + np.arange(numbers)]


def _positions(graph: FactorGraph, space: PoseSpace) -> tuple[np.ndarray, ...]:
    rows, fac, measured, information = _rows(graph, space.position)
    d, a = space.dim, np.zeros(rows.size, np.int64)
    b, lever = fac[:, at.F_I] + 1, measured[:, d:]
    return _made(graph, rows, fac, a, b, measured[:, :d], information, lever=lever)


def _headings(graph: FactorGraph) -> tuple[np.ndarray, ...]:
    rows, fac, measured, information = _rows(graph, at.HEADING_SE2)
    R, a = matrices_of_angles(measured[:, 0]), np.zeros(rows.size, np.int64)
    nothing = np.zeros((rows.size, 2))
    t_information = np.zeros((rows.size, 2, 2))
    turn = information[:, 0, 0]
    return _made(graph, rows, fac, a, fac[:, at.F_I] + 1, nothing, t_information, R=R, turn=turn)


def _linear_factors(graph: FactorGraph, space: PoseSpace) -> list[I64]:
    """The rows of the linear factors of a single pose of this space, and of those that join poses, by their kinds."""
    rows, found = np.flatnonzero(graph.fac[: graph.counts[at.FACTORS], at.F_KIND] == at.LINEAR), []
    for kind, of in graph.kinds_of(rows):
        poses = sum(end.code == space.pose for end in kind.connects)
        if poses > 1 or (poses == 1 and len(kind.connects) == 1):
            found.append(of)
    return found


def _linear(graph: FactorGraph, space: PoseSpace, rows: I64) -> tuple[np.ndarray, ...]:
    """Linear factors of one kind: of each two poses the relative pose where the factor was linearized, weighed by the
    block of both in HᵀΩH; of a single pose that pose, if the factor says something of all of it."""
    kind, d, dim = graph.kind_of(int(rows[0])), space.dim, 3 if space.dim == 2 else 6
    numbers = graph.payload[graph.fac[rows, at.F_AT, None] + np.arange(kind.width)]
    y, H = _split(kind, numbers)
    i, j = np.triu_indices(kind.dim)
    information = np.empty((rows.size, kind.dim, kind.dim))
    information[:, i, j] = information[:, j, i] = numbers[:, kind.size :]
    poses = [n for n, end in enumerate(kind.connects) if end.code == space.pose]
    ends = ends_of_rows(graph.fac, rows, len(kind.connects))
    pairs = [(a, b) for k, b in enumerate(poses) for a in poses[:k]] or [(-1, poses[0])]
    parts = []
    for a, b in pairs:
        (Rb, tb), Hb = poses_apart(y[b]), H[b]
        WH = information @ Hb
        weight = np.einsum("mri,mri->mi", Hb, WH)
        if a < 0:
            weight = np.where((weight > 0.0).all(axis=1, keepdims=True), weight, 0.0)
            node, R, t = np.zeros(rows.size, np.int64), Rb, tb
        else:
            Ra, ta = poses_apart(y[a])
            cross = np.abs(H[a].transpose(0, 2, 1) @ WH).max(axis=1)
            weight, back = np.minimum(weight, cross), Ra.transpose(0, 2, 1)
            node, R, t = ends[:, a] + 1, back @ Rb, (back @ (tb - ta)[:, :, None])[:, :, 0]
        t_information = weight[:, :d].mean(axis=1)[:, None, None] * np.eye(d)
        turn, of = weight[:, d:dim].mean(axis=1), graph.fac[rows]
        parts.append(_made(graph, rows, of, node, ends[:, b] + 1, t, t_information, R=R, turn=turn))
    return tuple(map(np.concatenate, zip(*parts, strict=True)))


def _split(kind: FactorKind, numbers: F64) -> tuple[list[F64], list[F64]]:
    """y (m, size) and H (m, rows, d) of each variable of m linear factors."""
    sizes, dims = [end.size for end in kind.connects], [end.dim for end in kind.connects]
    *y, rest = np.split(numbers, np.cumsum(sizes), axis=1)
    *H, _ = np.split(rest, np.cumsum([kind.dim * dim for dim in dims]), axis=1)
    return y, [J.reshape(-1, kind.dim, dim) for J, dim in zip(H, dims, strict=True)]


def _directions(graph: FactorGraph, space: PoseSpace) -> Directions:
    if space.dim == 2:
        return Directions(np.empty(0, np.int64), np.empty((0, 2)), np.empty((0, 2)), np.empty(0))
    _, fac, measured, information = _rows(graph, at.ATTITUDE_SE3)
    seen, there = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (measured[:, :3], measured[:, 3:]))
    return Directions(fac[:, at.F_I] + 1, seen, there, np.trace(information, axis1=1, axis2=2) / 3.0)
