"""Fill-in of the orderings of whole maps: by blocks near CHOLMOD's AMD, and what the constraint costs."""

from collections.abc import Iterable
from pathlib import Path

import pytest
from naive.block_rows import dense_lambda
from scipy.sparse import csc_matrix
from sksparse.cholmod import analyze as cholmod_analyze

from factorbus.formats import read
from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver
from factorbus.solver.elimination import constraint
from factorbus.solver.fill_in import fill_in
from factorbus.solver.kernels import layout as at

NEAR = 1.05
PRICE = 1.05


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
    graph, blocks = solver._graph, solver._system.blocks
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


def cholmod_nonzeros(solver: Solver) -> int:
    """Of CHOLMOD's factor of Λ, ordered by its AMD."""
    matrix = csc_matrix(dense_lambda(solver, sparse=True)[0])
    factor = cholmod_analyze(matrix, mode="simplicial", ordering_method="amd")
    factor.cholesky_inplace(matrix)
    return int(factor.L().nnz)
