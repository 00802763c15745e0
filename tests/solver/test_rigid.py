"""Subtrees that move as a whole: MATH (9.20).  Every clique is what its rows say, solved or moved along."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from naive.dense_factors import boxminus, pose_matrix, pose_vector
from naive.solver_parts import graph_in
from naive.tree_records import cliques, tree_of
from scipy.linalg import expm

from factorbus.proto.messages import Batch, Factors
from factorbus.simulate import Spiral, city_trees, manhattan, sphere
from factorbus.solver import Options, Solver
from factorbus.solver.graph.variables import VARIABLE_KIND_OF_CODE
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at

FAR = {
    "relinearize_next_step_share": 1e9,
    "relinearize_same_step_share": 1e9,
    "relinearize_max_error": np.inf,
    "converged_share": 1e9,
}
WORLDS: dict[str, Callable[[], Iterator[Batch]]] = {
    "poses": lambda: (step.batch for step in manhattan(500, 5)),
    "landmarks": lambda: (step.batch for step in city_trees(500, seed=5)),
    "space": lambda: (step.batch for step in sphere(400, 5, spiral=Spiral(20, 20))),
    "positions": lambda: with_positions(step.batch for step in manhattan(500, 5)),
}


def with_positions(steps: Iterator[Batch]) -> Iterator[Batch]:
    """Every fiftieth pose of a drive in the plane has a position."""
    for n, batch in enumerate(steps):
        if n % 50 == 49:
            group = batch.variables[0]
            assert group.values is None or group.kind == "se2"
            at_metres, information = np.array([[n % 7, n % 5, 0.0, 0.0]]), np.array([[1e-4, 0.0, 1e-4]])
            fix = Factors("position_se2", group.keys[-1:, None], at_metres, information)
            batch = Batch(batch.variables, (*batch.factors, fix))
        yield batch


def displacement(kind: str, x: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """J ξ by differences: how `x` moves in its tangent space when the map moves by `motion`, t and ω."""
    n = 2 if kind in ("se2", "point2") else 3
    ox, oy, oz = motion[3:]
    generator = np.zeros((n + 1, n + 1))
    generator[:n, :n] = np.array([[0, -oz, oy], [oz, 0, -ox], [-oy, ox, 0]])[:n, :n]
    generator[:n, n] = motion[:n]
    ends, step = [], 1e-4 / max(1.0, np.abs(motion).max())
    for sign in (1.0, -1.0):
        move = expm(sign * step * generator)
        if kind.startswith("point"):
            ends.append(move[:n, :n] @ x + move[:n, n] - x)
        else:
            ends.append(boxminus(kind, pose_vector(move @ pose_matrix(x)), x))
    return (ends[0] - ends[1]) / (2.0 * step)


def motions(solver: Solver) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """Of every clique [R_F R_S d], δ_F, δ_S as the frontals have it without having moved, and ξ."""
    tree, graph = tree_of(solver), graph_in(solver)
    for c, clique in cliques(solver).items():
        row = tree.clique[c]
        p, m, used = row[tl.C_PIVOTS], row[tl.C_SEPARATOR_SCALARS], row[tl.C_USED]
        rows = np.stack([tree.numbers[k : k + p + m + 1] for k in row[tl.C_ROWS] + row[tl.C_LD] * np.arange(p)])
        scalars = [int(graph.var[v, at.V_SCALAR]) for v in clique.frontals]
        sizes = [VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])].dim for v in clique.frontals]
        ours = np.concatenate([tree.scalars[0, d : d + n] for d, n in zip(scalars, sizes, strict=True)])
        since = c * tl.M_WIDTH
        motion = tree.motions[since : since + tl.MOTION] * row[tl.C_MOVES]
        moved = [tree.numbers[used + p : used + p + m]]
        if motion.any():
            forms = [VARIABLE_KIND_OF_CODE[int(graph.var[v, at.V_KIND])] for v in clique.separator]
            starts = [int(graph.var[v, at.V_AT]) for v in clique.separator]
            lin = [tree.lin[0, x : x + form.size] for x, form in zip(starts, forms, strict=True)]
            parts = [displacement(form.name, x, motion) for x, form in zip(lin, forms, strict=True)]
            moved.append(np.concatenate(parts))
        yield np.triu(rows), ours, np.sum(moved, axis=0), motion


@pytest.mark.parametrize("world", WORLDS)
def test_what_moved_along_is_solved(world: str) -> None:
    """R_F δ_F + R_S δ_S = d of every clique, with the separator where the frontals have it."""
    solver, moved, worst = Solver(Options.of(**FAR)), 0, 0.0
    for n, batch in enumerate(WORLDS[world]()):
        solver.stage(batch)
        solver.step()
        if n % 50 != 49:
            continue
        for rows, ours, others, motion in motions(solver):
            delta = np.concatenate([ours, others])
            missed = rows[:, :-1] @ delta - rows[:, -1]
            scale = np.abs(rows[:, :-1]) @ np.abs(delta) + np.abs(rows[:, -1]) + 1.0
            worst = max(worst, (np.abs(missed) / scale).max())
            moved += bool(motion.any())
    assert worst < 1e-8
    assert moved > (0 if world == "positions" else 20)


def test_what_has_a_position_below_it_does_not_move_along() -> None:
    solver = Solver(Options())
    for batch in WORLDS["positions"]():
        solver.stage(batch)
        solver.step()
    tree, graph = tree_of(solver), graph_in(solver)
    absolute = graph.fac[: solver.factor_count, at.F_KIND] == at.POSITION_SE2
    found, anchored = cliques(solver), set()
    for v in graph.fac[: solver.factor_count][absolute, at.F_I]:
        c = int(tree.node[v, tl.N_CLIQUE])
        while c >= 0:
            anchored.add(c)
            c = found[c].parent
    assert len(anchored) > 3
    flagged = {c for c in found if tree.clique[c, tl.C_ANCHORED]}
    assert anchored <= flagged < set(found)


@pytest.mark.parametrize("world", ["poses", "landmarks", "space"])
def test_to_move_along_is_as_good_as_to_be_solved(world: str) -> None:
    """χ² of the default along a drive, beside a tree that solves every clique."""
    exact, default = Solver(Options.of(wildfire_threshold=0.0, **FAR)), Solver(Options.of(**FAR))
    for n, batch in enumerate(WORLDS[world]()):
        for solver in (exact, default):
            solver.stage(batch)
            solver.step()
        if n % 20 == 19:
            assert default.chi2() <= 1.0005 * exact.chi2() + 1e-4
