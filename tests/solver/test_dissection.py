"""An order by nested dissection: it leaves R less to do in large plane graphs, and is for whole graphs only."""

from importlib.util import find_spec
from itertools import islice

import numpy as np
import pytest

from factorbus.cli.driving.columns import merged
from factorbus.proto.messages import Batch, Variables
from factorbus.simulate import city_trees, manhattan
from factorbus.solver import BatchSearch, Options, Solver, solve_batch
from factorbus.solver.sparse import dissection
from factorbus.solver.sparse.dissection import analyze_whole, dissect
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import analyze

needs_metis = pytest.mark.skipif(find_spec("pymetis") is None, reason="pymetis is not installed (the extra metis)")
Pattern = tuple[np.ndarray, np.ndarray, np.ndarray]


def grid(side: int, dim: int = 3) -> Pattern:
    """dims, rows, cols of Λ of a square grid."""
    at = np.arange(side * side).reshape(side, side)
    rows = np.concatenate([at.ravel(), at[:, :-1].ravel(), at[:-1].ravel()])
    cols = np.concatenate([at.ravel(), at[:, 1:].ravel(), at[1:].ravel()])
    return np.full(side * side, dim), rows, cols


@needs_metis
def test_it_is_a_permutation_that_leaves_less_to_do_than_minimum_degree() -> None:
    dims, rows, cols = grid(150)
    found = dissect(dims, rows, cols)
    np.testing.assert_array_equal(np.sort(found), np.arange(dims.size))
    by_degree = analyze(dims, rows, cols, order(dims, rows, cols))
    assert analyze(dims, rows, cols, found).flops < 0.8 * by_degree.flops


@needs_metis
def test_the_same_graph_has_the_same_order() -> None:
    pattern = grid(60)
    np.testing.assert_array_equal(dissect(*pattern), dissect(*pattern))


@needs_metis
def test_variables_of_several_sizes_and_of_none() -> None:
    dims, rows, cols = grid(20)
    dims = np.where(np.arange(dims.size) % 3, 2, 6)
    np.testing.assert_array_equal(np.sort(dissect(dims, rows, cols)), np.arange(dims.size))
    alone = np.array([3]), np.array([0]), np.array([0])
    np.testing.assert_array_equal(dissect(*alone), [0])


@needs_metis
def test_it_is_taken_where_eliminations_take_much_and_it_takes_less() -> None:
    pattern = grid(150)
    by_degree = analyze(*pattern, order(*pattern))
    assert analyze_whole(*pattern, times=1).flops == by_degree.flops
    assert analyze_whole(*pattern, times=100_000).flops < by_degree.flops


def test_without_it_there_is_minimum_degree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dissection, "find_spec", lambda _name: None)
    pattern = grid(60)
    np.testing.assert_array_equal(
        analyze_whole(*pattern, times=100_000).order, analyze(*pattern, order(*pattern)).order
    )


def whole(world: str, poses: int) -> Batch:
    drive = (manhattan if world == "streets" else city_trees)(poses, 4)
    graph = merged([step.batch for step in islice(drive, poses)])
    bare = tuple(group if group.fixed else Variables(group.kind, group.keys) for group in graph.variables)
    return Batch(bare, graph.factors)


@needs_metis
@pytest.mark.parametrize("world", ["streets", "trees"])
def test_the_optimum_is_the_same_by_either_order(world: str, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = whole(world, 800)
    expected = solve_batch(graph.variables, graph.factors)
    asked = []
    monkeypatch.setattr(dissection, "_WORTH_ASKING", 0.0)
    monkeypatch.setattr(dissection, "dissect", lambda *pattern: asked.append(pattern) or dissect(*pattern))
    # Whatever it leaves to do it is taken.
    monkeypatch.setattr(dissection, "analyze", _dearer_unless_dissected(asked))
    found = solve_batch(graph.variables, graph.factors)
    assert asked
    assert found.chi2 == pytest.approx(expected.chi2, rel=1e-9)
    assert found.starts.keys() == expected.starts.keys()
    for name, chi2 in expected.starts.items():
        assert found.starts[name] == pytest.approx(chi2, rel=1e-6)
    for group, other in zip(found.values, expected.values, strict=True):
        np.testing.assert_allclose(group.values, other.values, atol=1e-6)


def _dearer_unless_dissected(asked: list) -> object:
    from dataclasses import replace

    def analyzed(*pattern: np.ndarray) -> object:
        made = analyze(*pattern)
        return made if asked else replace(made, flops=1e300)

    return analyzed


def test_where_r_is_dear_it_makes_several_steps_to_the_same_optimum(monkeypatch: pytest.MonkeyPatch) -> None:
    from factorbus.solver.starts import descent

    graph = whole("streets", 800)
    expected = solve_batch(graph.variables, graph.factors, BatchSearch(polish=False))
    monkeypatch.setattr(descent, "_DEAR", 0.0)
    found = solve_batch(graph.variables, graph.factors, BatchSearch(polish=False))
    assert found.converged
    assert found.iterations > expected.iterations
    assert found.chi2 == pytest.approx(expected.chi2, rel=1e-9)


def test_steps_do_not_ask_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their bits would go by what is installed."""
    monkeypatch.setattr(dissection, "_WORTH_ASKING", 0.0)
    monkeypatch.setattr(dissection, "dissect", lambda *_: pytest.fail("asked"))
    for mode in ("bayes-tree", "inc-l"):
        solver = Solver(Options(mode=mode))
        for step in islice(manhattan(40, 1), 40):
            solver.stage(step.batch)
            solver.step(settle=True)
