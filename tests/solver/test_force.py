"""The error of a factor whose error is computed: what its linear model misses of the residual, and of the force.

Residuals and Jacobians are the kernels' own, which other tests hold against differences.  MATH (9.11), (9.31)
"""

import numpy as np
import pytest
from naive.dense_least_squares import full
from naive.random_graphs import camera_steps
from naive.random_others import other_steps
from naive.solver_parts import graph_in
from naive.tree_records import tree_of

from factorbus.solver import Options, Solver
from factorbus.solver.kernels.bayes_tree.exact_error import exact_error
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.sizes import dim_of, information_at, residual_dim

FAR = Options.of(
    relinearize_next_step_share=1e9,
    relinearize_same_step_share=1e9,
    relinearize_max_error=1e9,
    relinearize_max_wait=10**9,
    converged_share=1e9,
)


@pytest.mark.parametrize("world", ["camera", "robust camera", "others"])
def test_error_and_force_are_those_of_the_definition(world: str) -> None:
    steps = other_steps(3) if world == "others" else camera_steps(6018, loss="huber" if "robust" in world else "")
    solver = Solver(FAR)
    for batch in steps:
        solver.stage(batch)
        solver.step()
    graph, tree, seen = graph_in(solver), tree_of(solver), 0
    for f in range(solver.factor_count):
        kind = int(graph.fac[f, at.F_KIND])
        dim = residual_dim(kind)
        lin, now = (evaluated(graph, f, values) for values in (tree.lin[0], graph.values))
        if lin[0][at.R_STATUS] != now[0][at.R_STATUS]:
            continue  # an observation that lost its pixel or found it again
        p = int(graph.fac[f, at.F_AT] + information_at(kind))
        weight = full(graph.payload[p : p + dim * (dim + 1) // 2])
        model, force = lin[0][:dim].copy(), 0.0
        for end in range(2):
            v = int(graph.fac[f, at.F_I + end])
            if v < 0 or graph.var[v, at.V_SCALAR] < 0:
                continue
            size, start = dim_of(int(graph.var[v, at.V_KIND])), int(graph.var[v, at.V_SCALAR])
            was, here = lin[1 + end][:dim, :size], now[1 + end][:dim, :size]
            model += was @ tree.scalars[0][start : start + size]
            turned, diagonal = (here - was).T @ weight @ now[0][:dim], np.diag(here.T @ weight @ here)
            force += float(np.sum(turned[diagonal > 0] ** 2 / diagonal[diagonal > 0]))
        gap = now[0][:dim] - model
        error, told, chi2 = exact_error(
            f, graph.var, graph.fac, tree.lin[0], graph.values, graph.payload, tree.scalars[0]
        )
        assert error == pytest.approx(np.sqrt(max(gap @ weight @ gap, 0.0)), rel=1e-6, abs=1e-7)
        assert told == pytest.approx(np.sqrt(force), rel=1e-7, abs=1e-9)
        assert chi2 == pytest.approx(now[3] + now[0][:dim] @ weight @ now[0][:dim], rel=1e-9, abs=1e-12)
        seen += told > 1e-6
    assert seen > 5


def evaluated(graph, f: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """r, A, B, and what χ² has beside rᵀΩr."""
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    more = evaluate_apart(f, graph.var, graph.fac, values, graph.payload, r, A, B)
    return r, A, B, more
