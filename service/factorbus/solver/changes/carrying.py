"""Variables that go along when others are placed: each as it was to the first that a factor joins it to.  MATH §11.4.

A pose that was placed moved by M = x' x⁻¹, and what hangs on it moves by the same M: poses, points, features.
"""

import numpy as np

from factorbus.proto import kinds as wire
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import rows_of_factors, variables_aside
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.kinds import JOINS_PLACES, OF_FAMILY, VECTOR
from factorbus.solver.starts.relations import poses_apart
from factorbus.solver.starts.rotation_matrices import quaternions_of, turned_rays

_POSES = (at.SE2, at.SE3, at.SIM3)
_FLAT = (at.SE2, at.POINT2)


def carry_along(graph: FactorGraph, values: F64, placed: np.ndarray, stays: np.ndarray, kept: np.ndarray) -> F64:
    """`values` with all that is neither placed nor fixed where it was to what it hangs on, however indirectly.

    values: as in the graph, with what is placed where it is to be.  placed, stays (n,); kept (m,): of the factors.
    What no factor joins to anything placed or fixed stays where it is.
    """
    values, kind = values.copy(), graph.var[: placed.size, at.V_KIND]
    known = (placed | (graph.var[: placed.size, at.V_COLUMN] < 0)) & stays
    fac = graph.fac[: kept.size]
    joins = JOINS_PLACES[fac[:, at.F_KIND]]  # the first two variables: a mount, say, is not in the map
    joins[rows_of_factors(fac, np.flatnonzero(OF_FAMILY[fac[:, at.F_KIND]]))] = True
    ends = fac[kept & (fac[:, at.F_J] >= 0) & joins][:, [at.F_I, at.F_J]]
    ends = ends[~(VECTOR[kind[ends]] | np.isin(ends, variables_aside(fac))).any(axis=1)]
    ends = np.concatenate([ends, ends[:, ::-1]])  # (from, to)
    ends = ends[np.argsort(~np.isin(kind[ends[:, 0]], _POSES), kind="stable")]  # a point turns nothing
    while True:
        on = ends[known[ends[:, 0]] & ~known[ends[:, 1]] & stays[ends[:, 1]]]
        if not len(on):
            return values
        to, first = np.unique(on[:, 1], return_index=True)
        for space in (True, False):
            of = (np.isin(kind[to], _FLAT) == space) & (kind[to] != at.SO3)
            _move(graph, values, kind, on[first[of], 0], to[of], 2 if space else 3)
        of = kind[to] == at.SO3
        _turn(graph, values, kind, on[first[of], 0], to[of])
        known[to] = True


def _turn(graph: FactorGraph, values: F64, kind: I64, on: I64, to: I64) -> None:
    """Each rotation of `to` by what its one of `on` turned by; a point has not turned."""
    for one, other in zip(on.tolist(), to.tolist(), strict=True):
        at_q = wire.VARIABLE_KINDS[VARIABLE_KIND_OF_CODE[int(kind[one])].name].quaternion_at
        if at_q >= 0:
            rows = int(graph.var[one, at.V_AT]) + at_q + np.arange(4)
            mine = int(graph.var[other, at.V_AT]) + np.arange(4)
            R = _rotation(values[rows]) @ _rotation(graph.values[rows]).T @ _rotation(graph.values[mine])
            values[mine] = quaternions_of(R[None])[0]


def _rotation(quaternion: F64) -> F64:
    return poses_apart(np.concatenate([np.zeros(3), quaternion])[None])[0][0]


def _move(graph: FactorGraph, values: F64, kind: I64, on: I64, to: I64, d: int) -> None:
    """Each of `to` by what its one of `on` moved by; all in one space."""
    turn, shift, grown = _motions(graph, values, kind, on, d)
    start = graph.var[to, at.V_AT]
    place = graph.values[start[:, None] + np.arange(d)]
    values[start[:, None] + np.arange(d)] = grown[:, None] * (turn @ place[:, :, None])[:, :, 0] + shift
    plane, space, features = kind[to] == at.SE2, np.isin(kind[to], (at.SE3, at.SIM3)), kind[to] == at.IDP
    scaled = kind[to] == at.SIM3
    values[start[scaled] + 7] = graph.values[start[scaled] + 7] * grown[scaled]
    if plane.any():
        theta = graph.values[start[plane] + 2] + np.arctan2(turn[plane, 1, 0], turn[plane, 0, 0])
        values[start[plane] + 2] = theta - 2 * np.pi * np.floor((theta + np.pi) / (2 * np.pi))
    if space.any():
        R, _ = poses_apart(graph.values[start[space, None] + np.arange(7)])
        values[start[space, None] + 3 + np.arange(4)] = quaternions_of(turn[space] @ R)
    if features.any():
        turned = turned_rays(graph.values[start[features, None] + 3 + np.arange(2)], turn[features])
        values[start[features, None] + 3 + np.arange(2)] = turned


def _motions(graph: FactorGraph, values: F64, kind: I64, on: I64, d: int) -> tuple[F64, F64, F64]:
    """Rotation (n, d, d), translation (n, d) and scale (n,) of M, by which each has moved; of a point without a
    rotation, of all but similarities without a scale; of a rotation, which has no place, nothing."""
    start, size = graph.var[on, at.V_AT], 3 if d == 2 else 7
    turn = np.tile(np.eye(d), (on.size, 1, 1))
    before, after = (x[start[:, None] + np.arange(d)] for x in (graph.values, values))
    pose = np.isin(kind[on], _POSES)
    rows = start[pose, None] + np.arange(size)
    (R, _), (to_R, _) = poses_apart(graph.values[rows]), poses_apart(values[rows])
    turn[pose] = to_R @ R.transpose(0, 2, 1)
    grown, scaled, turned = np.ones(on.size), kind[on] == at.SIM3, kind[on] == at.SO3
    grown[scaled] = values[start[scaled] + 7] / graph.values[start[scaled] + 7]
    shift = after - grown[:, None] * (turn @ before[:, :, None])[:, :, 0]
    shift[turned] = 0.0
    return turn, shift, grown
