"""What the parts of a step take, reckoned before they are done.  MATH §9.10

A unit is one flop of a large front, so 6 · 10⁷ of them are about a millisecond.  What is no flop is counted in the time
that it takes, as measured: `docs/decisions/budget.md`.
"""

from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.jit.compile import F64, I64, inline_kernel
from factorbus.solver.kernels.sparse.subtrees import ASSEMBLY, BOOKKEEPING

ORDERING = 60_000.0  # of each variable that is eliminated: its order, its place in the new fronts
RELINEARIZING = 40_000.0  # of each variable that is relinearized: its factors
SOLVING = 40_000.0  # of each variable in a back-substitution: to move it, and to evaluate its factors
READING = 20.0  # of each number of R there
SCANNING = 600.0  # of each factor of the map, where all are looked through


@inline_kernel
def work_of_clique(row: I64) -> float:
    """To eliminate a clique again: (9.24), and to order its variables."""
    p, n = float(row[tl.C_PIVOTS]), float(row[tl.C_PIVOTS] + row[tl.C_SEPARATOR_SCALARS] + 1)
    return (p + ASSEMBLY) * n * n + BOOKKEEPING + ORDERING * row[tl.C_FRONTALS]


@inline_kernel
def work_of_cliques(cliques: I64, clique: I64) -> float:
    """The same of several."""
    work = 0.0
    for k in range(cliques.size):
        work += work_of_clique(clique[cliques[k]])
    return work


@inline_kernel
def work_of_solving(row: I64) -> float:
    """To solve a clique for its frontals."""
    p, m = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS]
    return READING * p * (m + 0.5 * p) + SOLVING * row[tl.C_FRONTALS]


@inline_kernel
def work_of_solving_all(cliques: I64, clique: I64) -> float:
    """The same of several."""
    work = 0.0
    for k in range(cliques.size):
        work += work_of_solving(clique[cliques[k]])
    return work


@inline_kernel
def note_work(work: float, totals: F64) -> None:
    """The step has taken this much more."""
    totals[tl.T_WORK] += work
