"""Do factors determine variables, whatever the factors weigh?  Asked before variables are refused.  MATH §7.

Λ = JᵀΩJ is positive definite where Ω is and J has full column rank: how much a row of J weighs does not matter to that,
only to Λ in doubles.
"""

import numpy as np

from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.graph.factor_rows import is_first, of_whole_factors
from factorbus.solver.graph.linearized import Linearized, linearized_factor
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

# Of the longest row of a factor, what may be rounding: Jacobians of a map that lies some thousand kilometres from its
# origin are 10⁻⁹ off.
_NOTHING = 1e-8


def have_full_rank(graph: FactorGraph, variables: I64, loosest: float) -> bool:
    """Whether the factors on these free variables determine them, all others held: (7.1) of JᵀJ, rows of J scaled to
    length 1, then columns, is at most `loosest`, of a normal vector in place of signs: a row with two equal entries
    hides from signs."""
    from scipy.sparse import coo_array, csc_array, diags_array
    from scipy.sparse.linalg import splu

    dims = graph.dims[graph.var[variables, at.V_COLUMN]]
    start, n = np.full(int(graph.counts[at.VARIABLES]), -1), int(dims.sum())
    start[variables] = np.cumsum(dims) - dims
    rows, columns, numbers, m = list[I64](), list[I64](), list[F64](), 0
    for first_row in _factors_on(graph, start >= 0):
        factor = linearized_factor(graph, first_row)
        place = np.concatenate(
            [_places(int(start[v]), d) for v, d in zip(factor.ends.tolist(), factor.dims.tolist(), strict=True)]
        )
        is_linear = graph.fac[first_row, at.F_KIND] == at.LINEAR
        J = _scaled(factor, place >= 0, is_linear)
        rows.append(m + np.repeat(np.arange(len(J)), J.shape[1]))
        columns.append(np.tile(place[place >= 0], len(J)))
        numbers.append(J.reshape(-1))
        m += len(J)
    J = coo_array((np.concatenate(numbers), (np.concatenate(rows), np.concatenate(columns))), shape=(m, n)).tocsc()
    length = np.sqrt(np.asarray((J * J).sum(0)))
    if not length.all():
        return False
    J = J @ diags_array(1.0 / length)
    try:
        answer = splu(csc_array(J.T @ J)).solve(np.random.default_rng(1).normal(size=n))
    except RuntimeError:  # a pivot is zero
        return False
    return bool(np.isfinite(answer).all() and np.abs(answer).max() <= loosest)


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
    none = length <= _NOTHING * longest
    return np.where(none[:, None], 0.0, J / np.where(none, 1.0, longest if is_linear else length)[:, None])
