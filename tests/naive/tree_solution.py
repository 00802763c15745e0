"""δ and χ² of a tree of cliques, checked against the dense normal equations at its linearization points."""

import copy

import numpy as np
import pytest
from naive.solver_parts import graph_in
from naive.tree_records import assert_is_a_tree, tree_of

from factorbus.solver import Solver
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.sparse.blocks import HessianBlocks


def assert_solves(solver: Solver) -> None:
    """δ is the solution of the dense normal equations at the linearization points, and the totals have its χ²."""
    assert_is_a_tree(solver)
    information, eta, chi2, delta = normal_equations(solver)
    assert_is_solution(solver, information, eta, chi2, delta, least=1e-9)


def assert_is_solution(
    solver: Solver, information: np.ndarray, eta: np.ndarray, chi2: float, delta: np.ndarray, least: float
) -> None:
    if delta.size:
        scale = np.sqrt(np.diag(information))
        unit = information / scale / scale[:, None]
        right = np.linalg.solve(unit, eta / scale)
        tell = max(least, 1e-15 * np.linalg.cond(unit))
        np.testing.assert_allclose(delta * scale, right, rtol=0, atol=tell * max(np.abs(right).max(), 1.0))
    model = chi2 - (delta @ eta if delta.size else 0.0)
    assert tree_of(solver).totals[tl.T_MODEL] == pytest.approx(model, rel=1e-9, abs=1e-9 * max(chi2, 1.0))


def normal_equations(solver: Solver) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Λ, η and χ² of all factors at the linearization points, by the kernels of the other modes; and δ."""
    graph = copy.copy(graph_in(solver))
    graph.fac, graph.values = graph.fac.copy(), tree_of(solver).lin[0].copy()
    blocks, scalars = HessianBlocks(), int(graph.counts[at.SCALARS])
    chi2 = blocks.extend(graph, (0,) * at.COUNTS)
    dims = graph.dims[: graph.counts[at.COLUMNS]]
    first = np.concatenate([[0], np.cumsum(dims)])
    information = np.zeros((scalars, scalars))
    for row, col, offset in zip(blocks.rows, blocks.cols, blocks.offsets, strict=True):
        r, c = (slice(first[k], first[k + 1]) for k in (row, col))
        information[r, c] = blocks.data[offset : offset + dims[row] * dims[col]].reshape(dims[row], dims[col])
        information[c, r] = information[r, c].T
    return information, blocks.eta[:scalars], chi2, tree_of(solver).scalars[0, :scalars]
