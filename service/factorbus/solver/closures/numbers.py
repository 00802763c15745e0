"""Closures of a ledger as a solver has them: poses, covariances and residuals."""

import math

import numpy as np

from factorbus.solver.closures.evidence import ClosureNumbers
from factorbus.solver.closures.ledger import Ledger
from factorbus.solver.closures.motions import inverse_motion, motions_of_poses, tangent_of
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.kernels.closures.ahead import weigh_residuals
from factorbus.solver.kernels.closures.back import Bools, list_free_ends, put_known, put_poses
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.bounds import MOST_NUMBER
from factorbus.solver.solver import Solver

_PLANE_DIM = 3


def closure_numbers(solver: Solver, ledger: Ledger, rows: I64, with_covariance: bool = True) -> ClosureNumbers:
    """Of some closures, with the poses they are between as the solver has them."""
    rows, graph = np.ascontiguousarray(rows), solver._graph
    ends = ledger.ends[rows].reshape(-1)
    if ledger.dim == _PLANE_DIM:
        values = np.empty((ends.size, 3))
        put_poses(rows, ledger.ends, graph.array_table, values)
    else:
        values = graph.values[graph.var[ends, at.V_AT, None] + np.arange(ledger.size)]
    known = np.empty((0, 0))
    if with_covariance:
        known = _try_known_in_plane(solver, ledger, rows) if ledger.dim == _PLANE_DIM else None
        known = _known(solver, ends, ledger.dim) if known is None else known
        if not math.isfinite(known.sum()):
            known = unsure_where_unknown(known)
    T = motions_of_poses(values)
    a, b = np.ascontiguousarray(T[0::2]), np.ascontiguousarray(T[1::2])
    return ClosureNumbers(a, b, ledger.z[rows], ledger.noise[rows], known)


def _try_known_in_plane(solver: Solver, ledger: Ledger, rows: I64) -> F64 | None:
    """The joint covariance of the ends of closures; None: one is fixed, or there is no R to read it from."""
    free, places, table = (
        np.empty(2 * rows.size, np.int64),
        np.empty((rows.size, 2), np.int64),
        solver._graph.array_table,
    )
    count = list_free_ends(rows, ledger.ends, table, free, places)
    if places.min(initial=0) < 0:
        return None
    known = solver.covariances.try_joint(free[:count], _PLANE_DIM * count)
    if known is None or count == free.size:
        return known
    out = np.empty((_PLANE_DIM * free.size, _PLANE_DIM * free.size))
    put_known(places, known, out)
    return out


def _known(solver: Solver, ends: I64, d: int) -> F64:
    """The same of any ends."""
    listed = ends.tolist()
    place = {v: k for k, v in enumerate(dict.fromkeys(listed))}
    different, where = np.array(list(place), np.int64), np.array([place[v] for v in listed], np.int64)
    source = solver.covariances
    is_free = bool((solver._graph.var[different, at.V_SCALAR] >= 0).all())
    known = source.try_joint(different, d * different.size) if is_free else None
    if known is None:
        known = CovarianceBlocks(source.try_view() or source.factored()).joint(different)
    if different.size < where.size:
        scalars = (where[:, None] * d + np.arange(d)).reshape(-1)
        known = known[scalars[:, None], scalars]
    return known


def unsure_where_unknown(known: F64) -> F64:
    """Numbers whose covariance is beyond doubles, as next to what hardly holds a map, have a large one, and nothing in
    common with others: so what is between them can be expected by nobody, and waits."""
    out = _separated(known, np.asarray(~np.isfinite(np.diagonal(known))))
    return _separated(out, np.asarray(~np.isfinite(out).all(axis=1)))


def _separated(known: F64, unknown: Bools) -> F64:
    """With MOST_NUMBER as the variance of these numbers."""
    out = np.where(np.logical_or.outer(unknown, unknown), 0.0, known)
    out[unknown, unknown] = MOST_NUMBER
    return np.asarray(out, np.float64)


def residuals_weighed(solver: Solver, ledger: Ledger, rows: I64) -> F64:
    """rᵀ W r (n,) of some closures, W their bounds."""
    if ledger.dim == _PLANE_DIM:
        out = np.empty(rows.size)
        weigh_residuals(rows, ledger.ends, ledger.z, ledger.bound, solver._graph.array_table, out)
        return out
    now = closure_numbers(solver, ledger, rows, False)
    r = tangent_of(inverse_motion(now.z) @ inverse_motion(now.a) @ now.b)
    return np.einsum("na,nab,nb->n", r, ledger.bound[rows], r)
