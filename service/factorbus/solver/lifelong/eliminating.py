"""Poses taken out of a graph: what they say of their neighbours, as relative factors along a tree.  MATH §11.6.

    1  Λ, η of the neighbours, the poses eliminated: dense, but of what the neighbours are to each other alone
    2  the tree that loses least: that of the smallest Σ log det of relative covariances, since coordinates along a tree
       have a Jacobian of determinant one (Chow and Liu; for poses Carlevaris-Bianco and Eustice, Mazuran and others);
       landmarks are its leaves
    3  a term for each branch, with the covariance that Λ has for it, and the gradient with which that of all stays:
       an estimate at its optimum stays where it is

What is lost is the Kullback–Leibler divergence of what the tree says of the neighbours from what was said, in nats.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from factorbus.solver.changes.marginal import reduced
from factorbus.solver.closures.motions import adjoint_motion, inverse_motion
from factorbus.solver.errors import Underconstrained
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.whitened import kind_of, whitened
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.lifelong.relative_terms import RelativeTerm, motion_of, value_of

# A new branch between two variables that have many neighbours each is taken where it loses less by so much, in log det,
# than one where there is a factor: so factors follow the area, too.  Figures: docs/decisions/sessions.md.
_MANY, _NEW_PAIR = 6, 3.0


Joined: TypeAlias = Mapping[int, Collection[int]]


class Eliminated(NamedTuple):
    """What takes the place of the factors on some poses, and what is lost by it, nats."""

    terms: list[RelativeTerm]
    loss: float


class _Branch(NamedTuple):
    """From pose i to variable j, with J of the coordinate by each, its covariance, and the log det of that."""

    i: int
    j: int
    A: F64
    B: F64
    covariance: F64
    log_det: float
    cost: float


def try_eliminate(graph: FactorGraph, poses: list[int], rows: Sequence[int], joined: Joined) -> Eliminated | None:
    """Without these poses; rows: of all their factors, which are relative ones; joined: neighbours of each variable.

    None: it cannot be told, as no pose is among their neighbours, or several fixed ones, or these are not determined.
    """
    whole = whitened(graph, rows, poses)
    others = whole.variables[len(poses) :]
    fixed = sorted({v for row in rows for v in graph.ends_of(row)} - set(whole.variables))
    ends = [*fixed, *(v for v in others if graph.var[v, at.V_KIND] in (at.SE2, at.SE3))]
    if not ends or len(fixed) > 1:
        return None
    if len(fixed) + len(others) == 1:
        return Eliminated([], 0.0)
    try:
        R, d = reduced(graph, whole, len(poses))
        information, eta = R.T @ R, R.T @ d
        more = sum(kind_of(graph, v).dim for v in fixed)
        information, eta = np.pad(information, (more, 0)), np.pad(eta, (more, 0))
        starts = {v: whole.starts[v] - whole.starts[others[0]] + more for v in others} | dict.fromkeys(fixed, 0)
        # One stays where it is: what is fixed, or where nobody says where the whole of them is, the first.
        free = np.arange(kind_of(graph, ends[0]).dim) + starts[ends[0]]
        free = np.setdiff1d(np.arange(eta.size), free)
        root = np.linalg.cholesky(information[np.ix_(free, free)])
    except (Underconstrained, np.linalg.LinAlgError):
        return None
    covariance, inverse = np.zeros_like(information), np.linalg.inv(root)
    covariance[np.ix_(free, free)] = inverse.T @ inverse
    branches = _tree(graph, ends, [v for v in others if v not in ends], _maker(graph, starts, covariance, joined))
    gradients = _gradients(branches, starts, eta, free)
    informations = [np.asarray(np.linalg.inv(b.covariance), np.float64) for b in branches]
    told = zip(branches, informations, gradients, strict=True)
    terms = [RelativeTerm(b.i, b.j, information, gradient) for b, information, gradient in told]
    loss = 0.5 * sum(b.log_det for b in branches) + float(np.log(root.diagonal()).sum())
    return Eliminated(terms, max(loss, 0.0))


def _tree(
    graph: FactorGraph, poses: list[int], landmarks: list[int], make: Callable[[int, int], _Branch]
) -> list[_Branch]:
    """Poses by Prim's algorithm, then each landmark from the pose that knows it best."""
    nearest = {v: make(poses[0], v) for v in poses[1:]}
    branches = list[_Branch]()
    while nearest:
        v = min(nearest, key=lambda v: nearest[v].cost)
        branches.append(nearest.pop(v))
        for other, so_far in nearest.items():
            nearest[other] = min(so_far, make(v, other), key=lambda branch: branch.cost)
    found = [[make(pose, landmark) for pose in poses] for landmark in landmarks]
    return [*branches, *(min(some, key=lambda branch: branch.cost) for some in found)]


def _maker(
    graph: FactorGraph, starts: dict[int, int], covariance: F64, joined: Joined
) -> Callable[[int, int], _Branch]:
    """Makes branches between two variables that begin at `starts` in `covariance`."""
    motions = {v: motion_of(graph, v) for v in starts if graph.var[v, at.V_KIND] in (at.SE2, at.SE3)}

    def make(i: int, j: int) -> _Branch:
        T = motions[i]
        if j in motions:
            A = -adjoint_motion(inverse_motion(motions[j]) @ T)
            B = np.eye(len(A))
        else:
            B = T[:-1, :-1].T
            A = np.hstack([-np.eye(len(B)), _cross(B @ (value_of(graph, j) - T[:-1, -1]))])
        of = np.concatenate([starts[i] + np.arange(A.shape[1]), starts[j] + np.arange(B.shape[1])])
        J = np.hstack([A, B])
        S = J @ covariance[of[:, None], of] @ J.T
        log_det = float(np.linalg.slogdet(S)[1])
        return _Branch(i, j, A, B, S, log_det, log_det + _price(joined, i, j))

    return make


def _price(joined: Joined, i: int, j: int) -> float:
    crowded = min(len(joined[i]), len(joined[j])) >= _MANY
    return _NEW_PAIR if crowded and j not in joined[i] else 0.0


def _cross(u: F64) -> F64:
    """By how much u changes as the pose turns that sees it."""
    if u.size == 2:
        return np.array([[u[1]], [-u[0]]])
    return np.array([[0.0, -u[2], u[1]], [u[2], 0.0, -u[0]], [-u[1], u[0], 0.0]])


def _gradients(branches: list[_Branch], starts: dict[int, int], eta: F64, free: I64) -> list[F64]:
    """One for each branch, Σ Jᵀ g = −η."""
    J, row, spans = np.zeros((free.size, eta.size)), 0, list[slice]()
    for b in branches:
        span = slice(row, row + len(b.B))
        J[span, starts[b.i] + np.arange(b.A.shape[1])] = b.A
        J[span, starts[b.j] + np.arange(b.B.shape[1])] = b.B
        spans.append(span)
        row = span.stop
    g = np.asarray(-np.linalg.solve(J[:, free].T, eta[free]), np.float64)
    return [g[span] for span in spans]
