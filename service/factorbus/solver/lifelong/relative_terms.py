"""What is known of one variable seen from a pose, as a quadratic, and the factor that says it.  MATH §11.6."""

from typing import NamedTuple

import numpy as np

from factorbus.solver.closures.motions import adjoint_motion, inverse_motion, motions_of_poses
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.whitened import kind_of, whitened
from factorbus.solver.kernels.jit.compile import F64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.starts.rotation_matrices import quaternions_of


class RelativeTerm(NamedTuple):
    """χ² = yᵀ Λ y + 2 gᵀ y + ..., y the coordinate of variable j seen from pose i, zero at the estimate.

    Of a pose y is the local increment of Tᵢ⁻¹ Tⱼ; of a landmark it is in metres, along the axes of the pose.
    """

    i: int
    j: int
    information: F64
    gradient: F64


def motion_of(graph: FactorGraph, pose: int) -> F64:
    """The pose as a matrix."""
    return motions_of_poses(value_of(graph, pose)[None])[0]


def value_of(graph: FactorGraph, variable: int) -> F64:
    """A view of the numbers of a variable."""
    start = int(graph.var[variable, at.V_AT])
    return graph.values[start : start + kind_of(graph, variable).size]


def turned_term(graph: FactorGraph, term: RelativeTerm) -> RelativeTerm:
    """A term between two poses, seen the other way round: y = −Ad(Tⱼ⁻¹ Tᵢ) y'."""
    M = -adjoint_motion(inverse_motion(motion_of(graph, term.j)) @ motion_of(graph, term.i))
    return RelativeTerm(term.j, term.i, M.T @ term.information @ M, M.T @ term.gradient)


def term_of_factors(graph: FactorGraph, rows: list[int], i: int, j: int) -> RelativeTerm:
    """What relative factors between pose i and variable j say together."""
    whole = whitened(graph, rows, [i, j])
    # With pose i held, y is the increment of j; that of a landmark is along the axes of the map.
    cut, turn = whole.starts[j], _axes_seen_from(graph, i, j)
    return RelativeTerm(i, j, turn @ whole.information[cut:, cut:] @ turn.T, -turn @ whole.eta[cut:])


def _axes_seen_from(graph: FactorGraph, i: int, j: int) -> F64:
    kind = kind_of(graph, j)
    return np.eye(kind.dim) if kind.code in (at.SE2, at.SE3) else motion_of(graph, i)[:-1, :-1].T


def factor_of_term(graph: FactorGraph, term: RelativeTerm) -> tuple[str, F64, F64]:
    """(kind, measurement, upper triangle of Ω): the factor with this Λ, and this gradient, at the estimate."""
    step = np.asarray(np.linalg.solve(term.information, term.gradient), np.float64)  # y from its optimum
    T, kind, triangle = motion_of(graph, term.i), kind_of(graph, term.j).code, np.triu_indices(step.size)
    if kind in (at.POINT2, at.POINT3):
        u = T[:-1, :-1].T @ (value_of(graph, term.j) - T[:-1, -1])
        return ("landmark_se2" if kind == at.POINT2 else "landmark_se3"), u - step, term.information[triangle]
    residual, B = _residual_of(step)
    Z = inverse_motion(T) @ motion_of(graph, term.j) @ inverse_motion(motions_of_poses(residual[None])[0])
    back = np.linalg.inv(B)
    information = (back.T @ term.information @ back)[triangle]
    if kind == at.SE2:
        return "between_se2", np.array([Z[0, 2], Z[1, 2], np.arctan2(Z[1, 0], Z[0, 0])]), information
    return "between_se3", np.concatenate([Z[:3, 3], quaternions_of(Z[None, :3, :3])[0]]), information


def _residual_of(step: F64) -> tuple[F64, F64]:
    """(E, B) with E the residual of a relative factor as a pose, and B its Jacobian by y, where B⁻¹ r is `step`."""
    size, turn = step.size, np.eye(step.size)
    if size == 3:
        residual = np.array([0.0, 0.0, step[2]])
        half = np.eye(1)
    else:
        # (w I + ⌊v⌋)⁻¹ v = v / w, so v / w is half of the step.
        w = 1.0 / np.sqrt(1.0 + 0.25 * step[3:] @ step[3:])
        v = 0.5 * w * step[3:]
        residual = np.concatenate([np.zeros(3), v, [w]])
        half = 0.5 * np.array([[w, -v[2], v[1]], [v[2], w, -v[0]], [-v[1], v[0], w]])
    R = motions_of_poses(residual[None])[0][:-1, :-1]
    turn[: len(R), : len(R)], turn[len(R) :, len(R) :] = R, half
    residual[: len(R)] = R @ step[: len(R)]
    return residual, turn
