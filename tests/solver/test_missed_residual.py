"""What the linear model of a factor between poses misses of its residual, against its definition.  MATH (9.33), (9.34)

Residuals and Jacobians are the kernels' own, which other tests hold against differences.
"""

import numpy as np
import pytest
from naive.dense_least_squares import full
from naive.solver_parts import NEVER_RELINEARIZES, graph_in
from naive.tree_records import tree_of

from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver
from factorbus.solver.kernels.bayes_tree.missed_residual import missed_error_se2, missed_error_se3, missed_se3
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.bayes_tree.seen_in_space import between_se3_chi2
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.retract import move
from factorbus.solver.kernels.model.sizes import information_at, residual_dim

NEVER = Options.of(**NEVER_RELINEARIZES)


@pytest.mark.parametrize("world", ["manhattan", "sphere"])
@pytest.mark.parametrize("turn", [1e-4, 0.05, 0.2])
def test_what_is_missed_is_the_residual_less_the_model(world: str, turn: float) -> None:
    """At linearization points that are off by `turn` rad, and by as much of what lies between the poses."""
    solver, rng, largest = Solver(NEVER), np.random.default_rng(5), 0.0
    for step in WORLDS[world](60, 3):
        solver.stage(step.batch)
        solver.step()
    graph, tree = graph_in(solver), tree_of(solver)
    graph_arrays, tree_arrays = graph_at(graph.array_table), tree_at(tree.array_table)
    tree.scalars[0] = turn * rng.standard_normal(tree.scalars[0].size)
    put_estimate(graph, tree)
    for f in range(solver.factor_count):
        kind = int(graph.fac[f, at.F_KIND])
        if kind not in (at.BETWEEN_SE2, at.BETWEEN_SE3):
            continue
        dim = residual_dim(kind)
        r0, A, B = evaluated(graph, f, tree.lin[0])
        r1, _, _ = evaluated(graph, f, graph.values)
        b = r1 - r0
        for end, J in ((at.F_I, A), (at.F_J, B)):
            start = int(graph.var[graph.fac[f, end], at.V_SCALAR])
            if start >= 0:
                b -= J @ tree.scalars[0][start : start + dim]
        p = int(graph.fac[f, at.F_AT] + information_at(kind))
        weight = full(graph.payload[p : p + dim * (dim + 1) // 2])
        if kind == at.BETWEEN_SE3:
            _, _, seen = between_se3_chi2(f, graph_arrays, tree_arrays)
            np.testing.assert_allclose(missed_se3(graph_arrays, tree_arrays, f, seen)[:6], b, rtol=1e-7, atol=1e-12)
            told, shift, psi = missed_error_se3(graph_arrays, tree_arrays, f, seen)
        else:
            b[2] = (b[2] + np.pi) % (2 * np.pi) - np.pi
            weight = np.diag([max(weight[0, 0], weight[1, 1])] * 2 + [0.0])
            told, _, square, _, psi = missed_error_se2(graph_arrays, tree_arrays, f)
            shift = square**0.5
        assert told == pytest.approx(np.sqrt(b @ weight @ b), rel=1e-6, abs=1e-9)
        moved, turned = relative_motion(graph, f, tree.lin[0])
        assert shift == pytest.approx(moved, rel=1e-6, abs=1e-9)
        assert psi == pytest.approx(turned, rel=1e-6, abs=1e-8)
        largest = max(largest, told)
    assert largest > 0.1 * turn**2


def put_estimate(graph, tree) -> None:
    """The values are those of the tree's δ."""
    move(int(graph.counts[at.VARIABLES]), graph.var, tree.lin[0].copy(), tree.scalars[0].copy(), graph.values)


def evaluated(graph, f: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """r, A, B."""
    dim = residual_dim(int(graph.fac[f, at.F_KIND]))
    r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
    evaluate_apart(f, graph.var, graph.fac, values, graph.payload, r, A, B)
    return r[:dim], A[:dim, :dim], B[:dim, :dim]


def relative_motion(graph, f: int, lin: np.ndarray) -> tuple[float, float]:
    """By how much the second pose has shifted and turned as seen from the first, between `lin` and the values.

    In space the chord of the turn, 2 sin ½ψ.
    """
    seen = []
    for values in (lin, graph.values):
        i, j = (matrix_of(graph, int(graph.fac[f, end]), values) for end in (at.F_I, at.F_J))
        seen.append(np.linalg.inv(i) @ j)
    was, now = seen
    turn = was[:-1, :-1].T @ now[:-1, :-1]
    angle = np.arcsin(np.linalg.norm(turn - turn.T) / np.sqrt(8.0))
    shift = float(np.linalg.norm(now[:-1, -1] - was[:-1, -1]))
    return shift, float(angle if len(turn) == 2 else 2.0 * np.sin(0.5 * angle))


def matrix_of(graph, v: int, values: np.ndarray) -> np.ndarray:
    """A pose as a homogeneous matrix."""
    x = values[int(graph.var[v, at.V_AT]) :]
    if int(graph.var[v, at.V_KIND]) == at.SE2:
        c, s = np.cos(x[2]), np.sin(x[2])
        return np.array([[c, -s, x[0]], [s, c, x[1]], [0, 0, 1]])
    a, w = x[3:6], x[6]
    cross = np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = np.eye(3) + 2 * w * cross + 2 * cross @ cross, x[:3]
    return made
