"""The error of a factor whose error is computed: what its linear model misses of the residual, and of the force.

Residuals and Jacobians are the kernels' own, which other tests hold against differences.  MATH (9.11), (9.31)
"""

import numpy as np
import pytest
from naive.dense_least_squares import full, rho
from naive.own_formulas import both
from naive.random_graphs import camera_steps
from naive.random_imu import imu_steps
from naive.random_mounts import mount_steps
from naive.random_others import other_steps
from naive.solver_parts import NEVER_RELINEARIZES, graph_in, row_count
from naive.tree_records import tree_of

from factorbus.solver import Options, Solver
from factorbus.solver.graph.factor_rows import are_of_many, is_first, losses_of
from factorbus.solver.kernels.bayes_tree.exact_error import exact_error
from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_at
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.candidates import evaluate_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.records import graph_at

FAR = Options.of(**NEVER_RELINEARIZES)


WORLDS = {
    "camera": lambda: camera_steps(6018),
    "robust camera": lambda: camera_steps(6018, loss="huber"),
    "others": lambda: other_steps(3),
    "own": lambda: (own for _, own in both(3)),
    "robust own": lambda: (own for _, own in both(3, loss="cauchy")),
    "imu": lambda: imu_steps(3),
    "robust mounts": lambda: mount_steps(3, loss="cauchy"),
}


@pytest.mark.parametrize("world", WORLDS)
def test_error_and_force_are_those_of_the_definition(world: str) -> None:
    solver = Solver(FAR)
    for batch in WORLDS[world]():
        solver.stage(batch)
        solver.step()
    graph, tree, seen = graph_in(solver), tree_of(solver), 0
    for f in np.flatnonzero(is_first(graph.fac[: row_count(solver)])).tolist():
        (r, was, weight, _), (now, here, _, more) = (evaluated(graph, f, of) for of in (tree.lin[0], graph.values))
        if not are_of_many(graph.fac[f : f + 1])[0] and r[at.R_STATUS] != now[at.R_STATUS]:
            continue  # an observation that lost its pixel or found it again
        dim = len(weight)
        model, force = r[:dim].copy(), 0.0
        if graph.fac[f, at.F_KIND] == at.IMU:  # whose model is corrected where it is added off its point
            k = jacobian_at(f, graph.var, graph.fac, tree.link)
            model = tree.hessian[k : k + dim].copy() if is_plain_imu(graph, f, weight) else model
        for end, v in enumerate(graph.ends_of(f)):
            if graph.var[v, at.V_SCALAR] < 0:
                continue
            start, J, J_now = int(graph.var[v, at.V_SCALAR]), was[end], here[end]
            model += J @ tree.scalars[0][start : start + J.shape[1]]
            held = J if is_plain_imu(graph, f, weight) else J_now  # whose J is not made anew for it
            turned, diagonal = (J_now - J).T @ weight @ now[:dim], np.diag(held.T @ weight @ held)
            force += float(np.sum(turned[diagonal > 0] ** 2 / diagonal[diagonal > 0]))
        gap = now[:dim] - model
        error, told, chi2 = error_at(f, graph.array_table, tree.array_table)
        assert error == pytest.approx(np.sqrt(max(gap @ weight @ gap, 0.0)), rel=1e-6, abs=1e-7)
        # Samples near their bias are expanded, to 1e-5 standard deviations.
        rel, least = (1e-4, 1e-5) if world == "imu" else (1e-7, 1e-9)
        assert told == pytest.approx(np.sqrt(force), rel=rel, abs=least)
        rel, least = (1e-4, 1e-8) if world == "imu" else (1e-9, 1e-12)
        assert chi2 == pytest.approx(more + now[:dim] @ weight @ now[:dim], rel=rel, abs=least)
        seen += told > 1e-6
    assert seen > 5


def is_plain_imu(graph, f: int, weight: np.ndarray) -> bool:
    """Samples without a loss whose Ω is one."""
    return bool(
        graph.fac[f, at.F_KIND] == at.IMU and not losses_of(graph.fac[f]) and (weight == np.eye(len(weight))).all()
    )


@part
def error_at(f: int, graph_table: I64, tree_table: I64) -> tuple[float, float, float]:
    """Of factor f, with the arrays that the tables are of."""
    return exact_error(f, graph_at(graph_table), tree_at(tree_table))


def evaluated(graph, f: int, values: np.ndarray) -> tuple[np.ndarray, list[np.ndarray], np.ndarray, float]:
    """r, the Jacobians, Ω, and what χ² has beside rᵀΩr."""
    dim, dims = graph.kind_of(f).dim, [end.dim for end in graph.kind_of(f).connects]
    p = int(graph.fac[f, at.F_AT] + graph.kind_of(f).information_at)
    weight = full(graph.payload[p : p + dim * (dim + 1) // 2])
    if are_of_many(graph.fac[f : f + 1])[0]:
        r, J, W = np.empty(dim), np.empty((dim, sum(dims))), np.empty((dim, dim))
        evaluate_many(f, graph.array_table, values, r, J, W)
        more, square, k = 0.0, float(r @ W @ r), float(graph.payload[p + dim * (dim + 1) // 2])
        if losses_of(graph.fac[f]):  # r and J are times √w, w = k²/(k² + s)
            more = float(rho("cauchy", k, square / (1.0 - square / k**2))) - square
        return r, np.split(J, np.cumsum(dims)[:-1], axis=1), weight, more
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    more = evaluate_apart(f, graph.var, graph.fac, values, graph.payload, r, A, B)
    return r, [J[:dim, :d] for J, d in zip((A, B), dims, strict=False)], weight, more
