"""Fill-in of the orderings of whole maps: by blocks near CHOLMOD's AMD, and what the constraint costs."""

from collections.abc import Iterable
from pathlib import Path

import pytest
from naive.block_rows import dense_lambda
from naive.cholmod import cholmod
from naive.solver_parts import graph_in, system_in
from naive.tree_records import tree_of
from scipy.sparse import csc_matrix

from factorbus.formats import read
from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.sparse.elimination import constraint
from factorbus.solver.sparse.fill_in import fill_in

NEAR = 1.05
PRICE = 1.05
WELL_ORDERED = 1.25  # city10000: 1.10 to 1.19, by where thresholds have its last steps order anew; others 1.00


@pytest.mark.parametrize(("world", "poses"), [("manhattan", 1500), ("city_trees", 1500), ("sphere", 400)])
def test_fill_of_worlds_is_near_that_of_cholmod(world: str, poses: int) -> None:
    assert_fills_little(world, [step.batch for step in WORLDS[world](poses, 3)])


@pytest.mark.data
@pytest.mark.parametrize("name", ["intel", "manhattan3500", "killian", "w10000", "citytrees10000", "victoria_park"])
def test_fill_of_the_papers_data_sets_is_near_that_of_cholmod(datasets: Path, name: str) -> None:
    assert_fills_little(name, read(datasets / f"{name}.g2o").steps())


def assert_fills_little(name: str, steps: Iterable[Batch]) -> None:
    """By blocks without the constraint as CHOLMOD's AMD within 5 %; the constraint adds as little."""
    solver = Solver(Options(mode="all-batch", max_iterations=0))
    for batch in steps:
        solver.stage(batch)
    solver.step()
    graph, blocks = graph_in(solver), system_in(solver).blocks
    dims = graph.dims[: graph.counts[at.COLUMNS]]
    free, last, recent = (
        fill_in(dims, blocks.rows, blocks.cols, group)[0]
        for group in (None, constraint(graph), constraint(graph, recent_poses=10))
    )
    amd = cholmod_nonzeros(solver)
    print(f"{name}: nonzeros of R {free}, {free / amd:.4f} of CHOLMOD's AMD {amd}; with the last pose last and the")
    print(f"  landmarks it sees before it {last / free - 1:+.2%}, with those of ten poses {recent / free - 1:+.2%}")
    assert free <= NEAR * amd
    assert last <= PRICE * free
    assert recent <= PRICE * free


@pytest.mark.parametrize(("world", "poses"), [("manhattan", 1500), ("city_trees", 1500), ("sphere", 400)])
def test_step_by_step_the_tree_of_worlds_fills_as_if_ordered_at_once(world: str, poses: int) -> None:
    assert_stays_well_ordered(world, [step.batch for step in WORLDS[world](poses, 3)])


@pytest.mark.data
@pytest.mark.parametrize("name", ["intel", "manhattan3500", "citytrees10000", "victoria_park", "city10000"])
def test_step_by_step_the_tree_of_public_data_fills_as_if_ordered_at_once(datasets: Path, name: str) -> None:
    assert_stays_well_ordered(name, read(datasets / f"{name}.g2o").steps())


def assert_stays_well_ordered(name: str, steps: Iterable[Batch]) -> None:
    """After re-ordering only what each step affects, R has little more than after ordering all variables anew."""
    solver = Solver()
    for batch in steps:
        solver.stage(batch)
        solver.step()
    tree = tree_of(solver)
    grown = int(tree.state[tl.S_NONZEROS])
    tree.move_all()
    solver.step()
    at_once = int(tree.state[tl.S_NONZEROS])
    assert int(tree.state[tl.S_ELIMINATED]) >= solver.variable_count - 1, "all are ordered anew"
    print(f"{name}: nonzeros of R {grown}, {grown / at_once:.3f} of those when ordered at once")
    assert grown <= WELL_ORDERED * at_once


def cholmod_nonzeros(solver: Solver) -> int:
    """Of CHOLMOD's factor of Λ, ordered by its AMD."""
    matrix = csc_matrix(dense_lambda(solver, sparse=True)[0])
    factor = cholmod().analyze(matrix, mode="simplicial", ordering_method="amd")
    factor.cholesky_inplace(matrix)
    return int(factor.L().nnz)
