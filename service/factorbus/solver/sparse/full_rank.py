"""Do factors determine variables?  Asked before variables are refused for their numbers.  MATH §7.

Λ = JᵀΩJ has lost the digits that tell where factors weigh very differently, and Ω^½ J has not.  And Λ is positive
definite where Ω is and J has full column rank: how much a row of J weighs does not matter to that.
"""

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, of_whole_factors
from factorbus.solver.graph.linearized import JACOBIAN_ROUNDING, Linearized, linearized_factor
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

# The least eigenvalue of JᵀJ, columns of J scaled to length 1, with which a dense solve has a digit or two left.
LEAST_EIGENVALUE = 1e-13
# One of no more is nothing but rounding, whatever the rows weigh.
_SINGULAR = 1e-25
# Of r beside x in (7.2): near the least singular value that is asked about.
_ALPHA = 1e-6
_ROUNDS = 4


def have_full_rank(graph: FactorGraph, variables: I64) -> bool:
    """Whether the factors on these free variables determine them, all others held: with rows of J scaled to length 1,
    or as they weigh."""
    dims = graph.dims[graph.var[variables, at.V_COLUMN]]
    start, n = np.full(int(graph.counts[at.VARIABLES]), -1), int(dims.sum())
    start[variables] = np.cumsum(dims) - dims
    rows, columns, weighted, scaled, m = list[I64](), list[I64](), list[F64](), list[F64](), 0
    for first_row in _factors_on(graph, start >= 0):
        factor = linearized_factor(graph, first_row)
        place = np.concatenate(
            [_places(int(start[v]), d) for v, d in zip(factor.ends.tolist(), factor.dims.tolist(), strict=True)]
        )
        is_linear = graph.fac[first_row, at.F_KIND] == at.LINEAR
        J = _scaled(factor, place >= 0, is_linear)
        rows.append(m + np.repeat(np.arange(len(J)), J.shape[1]))
        columns.append(np.tile(place[place >= 0], len(J)))
        weighted.append((np.linalg.cholesky(factor.W).T @ factor.J[:, place >= 0]).reshape(-1))
        scaled.append(J.reshape(-1))
        m += len(J)
    if m < n:
        return False
    places = np.concatenate(rows), np.concatenate(columns)
    found = least_eigenvalue(np.concatenate(scaled), *places, (m, n))
    if _SINGULAR < found < LEAST_EIGENVALUE:
        found = least_eigenvalue(np.concatenate(weighted), *places, (m, n))
    return found >= LEAST_EIGENVALUE


def least_eigenvalue(numbers: F64, rows: I64, columns: I64, shape: tuple[int, int]) -> float:
    """The least eigenvalue of JᵀJ, columns of J (m, n) scaled to length 1, by inverse iteration; 0: it is singular.

    JᵀJ x = −α b by (7.2), whose condition number is that of J, not its square:

        [ α I  J ] [ r ]   [ 0 ]
        [ Jᵀ     ] [ x ] = [ b ]
    """
    from scipy.sparse import block_array, coo_array, csc_array, diags_array, eye_array
    from scipy.sparse.linalg import splu

    m, n = shape
    J = coo_array((numbers, (rows, columns)), shape=shape).tocsc()
    length = np.sqrt(np.asarray((J * J).sum(0)))
    if not length.all():
        return 0.0
    J = J @ diags_array(1.0 / length)
    try:
        solve = splu(csc_array(block_array([[_ALPHA * eye_array(m), J], [J.T, None]]))).solve
    except RuntimeError:  # a pivot is zero
        return 0.0
    b, size = np.random.default_rng(1).normal(size=n), 0.0
    for _ in range(_ROUNDS):
        x = solve(np.concatenate([np.zeros(m), b / np.linalg.norm(b)]))[m:] / _ALPHA
        b, size = x, float(np.linalg.norm(x))
        if not 0.0 < size < np.inf:
            return 0.0
    return 1.0 / size


def _factors_on(graph: FactorGraph, wanted: np.ndarray) -> list[int]:
    """The first rows of the factors on any of the `wanted` (variables,)."""
    fac = graph.fac[: graph.counts[at.FACTORS]]
    on = of_whole_factors(fac, wanted[fac[:, at.F_I]] | ((fac[:, at.F_J] >= 0) & wanted[fac[:, at.F_J]]))
    return np.flatnonzero(on & is_first(fac)).tolist()


def _places(start: int, dim: int) -> I64:
    """The scalars of a variable, −1 for one that is held."""
    return start + np.arange(dim) if start >= 0 else np.full(dim, -1)


def _scaled(factor: Linearized, wanted: np.ndarray, is_linear: bool) -> F64:
    """(dim, columns) J in the `wanted` columns, decorrelated, each row of length 1 or nothing.

    is_linear: all by the same factor.  What a linear one says least of is as good as the point where it was linearized.
    """
    D = np.sqrt(factor.W.diagonal())
    whole = np.linalg.cholesky(factor.W / D / D[:, None]).T @ factor.J
    J, longest = whole[:, wanted], np.sqrt((whole * whole).sum(1).max())
    length = np.sqrt((J * J).sum(1))
    none = length <= JACOBIAN_ROUNDING * longest
    return np.where(none[:, None], 0.0, J / np.where(none, 1.0, longest if is_linear else length)[:, None])
