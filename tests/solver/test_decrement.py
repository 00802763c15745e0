"""What a Gauss-Newton step would take off χ², by the R that there is: against dense matrices.  MATH (9.39), (9.40)"""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import pytest
from bench.every import hard, late
from bench.every.motion import PLANE, SPACE
from naive.random_mounts import mount_steps
from naive.solver_parts import NEVER_RELINEARIZES, graph_in
from naive.tree_records import tree_of

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver
from factorbus.solver.divergence import copied
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.decrement import DIRECTIONS, decrement
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.factor_rows import count_ends, end_of, is_member, is_one_of_many
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.many import linearize_many
from factorbus.solver.kernels.model.records import graph_at
from factorbus.solver.kernels.model.sizes import dim_of, information_at, residual_dim

# Nothing is relinearized, and nothing left undone: so linearization errors are large, and all that the gradient has.
NEVER = Options.of(**NEVER_RELINEARIZES, wildfire_threshold=0.0)


def drive_of(name: str) -> Iterator[Batch]:
    """Steps with factors of one, two and more variables."""
    if name == "mounted":
        return mount_steps(3)
    return hard.late_positions(SPACE if name == "space" else PLANE, 60, 3)


@pytest.mark.parametrize("name", ["plane", "space", "mounted"])
def test_it_is_that_of_dense_matrices(name: str) -> None:
    solver = Solver(NEVER)
    for batch in drive_of(name):
        solver.stage(batch)
        solver.step()
    graph, tree = graph_in(solver), tree_of(solver)
    delta = tree.scalars[0, : int(graph.counts[at.SCALARS])]
    was, model = normal_equations(solver, tree.lin[0])
    now, gradient = normal_equations(solver, graph.values)
    assert np.abs(was @ delta + model).max() < 1e-6, "the linear models are solved"
    step = np.linalg.solve(was, gradient)
    square = gradient @ step
    assert square > 1e-3
    arrays = graph_at(graph.array_table), tree_at(tree.array_table)
    assert decrement(-1.0, False, np.inf, *arrays) == pytest.approx(square, rel=1e-6)
    gains = conjugate_gains(now, was, gradient, DIRECTIONS)
    assert gains[0] < gains[-1] <= gradient @ np.linalg.solve(now, gradient) * (1.0 + 1e-9)
    for k, (before, gain) in enumerate(pairwise([0.0, *(gain * (1.0 + 1e-9) for gain in gains)])):
        if before < square:
            of_rounding = 1e-6 if k < 2 else 1e-2  # directions lose what makes them conjugate
            assert decrement(-1.0, False, before, *arrays) == pytest.approx(gain, rel=of_rounding)


def conjugate_gains(now: np.ndarray, was: np.ndarray, gradient: np.ndarray, most: int) -> list[float]:
    """What the best step takes off in the space of the first k directions w of was w = (now was⁻¹)^(k−1) gradient."""
    space, gains = [np.linalg.solve(was, gradient)], []
    for _ in range(most):
        basis, _ = np.linalg.qr(np.array(space).T)
        projected = basis.T @ gradient
        gains.append(float(projected @ np.linalg.solve(basis.T @ now @ basis, projected)))
        space.append(np.linalg.solve(was, now @ basis[:, -1]))
    return gains


def normal_equations(solver: Solver, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Σ JᵀΩJ and Σ JᵀΩr of all factors at x."""
    graph = graph_in(solver)
    size = int(graph.counts[at.SCALARS])
    Lambda, gradient = np.zeros((size, size)), np.zeros(size)
    for f in range(int(graph.counts[at.FACTORS])):
        if is_member(f, graph.fac):
            continue
        J, r, weight = linearized(graph, f, x, size)
        Lambda += J.T @ weight @ J
        gradient += J.T @ weight @ r
    return Lambda, gradient


def linearized(graph, f: int, x: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """J over all scalars, r and Ω of factor f at x."""
    ends = [int(end_of(f, n, graph.fac)) for n in range(count_ends(f, graph.fac))]
    starts = [int(graph.var[v, at.V_SCALAR]) for v in ends]
    dims = [int(dim_of(graph.var[v, at.V_KIND])) for v in ends]
    if is_one_of_many(f, graph.fac):
        _, many = linearize_many(f, graph.var, graph.fac, x, graph.payload)
        r, weight = many.r[: len(many.J)], np.eye(len(many.J))
        blocks = [many.J[:, a:b] for a, b in zip(many.start[:-1], many.start[1:], strict=True)]
    else:
        dim = int(residual_dim(graph.fac[f, at.F_KIND]))
        r, H = np.zeros(at.R_SIZE), np.zeros((2, 6, 6))
        evaluate_apart(f, graph.var, graph.fac, x, graph.payload, r, H[0], H[1])
        p = int(graph.fac[f, at.F_AT] + information_at(graph.fac[f, at.F_KIND]))
        weight = np.zeros((dim, dim))
        weight[np.triu_indices(dim)] = graph.payload[p : p + dim * (dim + 1) // 2]
        weight = weight + np.triu(weight, 1).T
        r, blocks = r[:dim], [H[n, :dim, :d] for n, d in enumerate(dims)]
    J = np.zeros((len(r), size))
    for start, d, block in zip(starts, dims, blocks, strict=True):
        if start >= 0:
            J[:, start : start + d] += block
    return J, r, weight


# A drive; its first steps that count, and the last: Σ error² and what a Gauss-Newton step took off, in shares of χ².
TURNED_ALIKE = {
    "positions": (hard.late_positions, 720734012, 221, 240),  # 3e-4 and 1.4e-3
    "positions in a frame": (late.late_frames, 1686703626, 205, 225),  # 3.7e-4 and 1.1e-3
}


@pytest.mark.parametrize("name", TURNED_ALIKE)
def test_where_many_jacobians_turn_alike_a_step_has_not_converged_until_the_estimate_is_there(name: str) -> None:
    """Of 160 positions each alone misses little, but their forces add up."""
    (drive, seed, first, last), solver, checked = TURNED_ALIKE[name], Solver(), 0
    for i, batch in enumerate(drive(SPACE, 300, seed)):
        if i > last:
            break
        solver.stage(batch)
        report = solver.step()
        if i >= first and report.converged:
            assert report.chi2 <= 1.0007 * copied(solver).step(settle=True).chi2
            checked += 1
    assert checked > 15
    assert tree_of(solver).totals[tl.T_ERROR] > 0.0
