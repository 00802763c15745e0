"""Worker threads: what an elimination comes to does not depend on them, nor does it wait for them."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.tree_records import tree_of

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import manhattan
from factorbus.simulate.step import POSE
from factorbus.solver import Options, Solver
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.kernels.sparse.partial_cholesky import factor_front
from factorbus.solver.kernels.sparse.subtrees import (
    ASSEMBLY,
    BOOKKEEPING,
    END,
    FIRST,
    LONG,
    PIECES,
    TURN,
    cut_subtrees,
    cut_whole,
)
from factorbus.solver.kernels.sparse.task_queue import MOST
from factorbus.solver.sparse.cholesky import Cholesky
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze
from factorbus.solver.sparse.worker_threads import TASK_QUEUE, WorkerThread, count_free

pytestmark = pytest.mark.skipif(
    count_free() == 0, reason="threads cannot sleep in kernels here, so no core can be working"
)

POSES = 1500


@contextmanager
def working(count: int = 1) -> Iterator[list[WorkerThread]]:
    """A number of worker threads meanwhile."""
    workers = [WorkerThread() for _ in range(count)]
    threads = [threading.Thread(target=worker.run) for worker in workers]
    for thread in threads:
        thread.start()
    try:
        yield workers
    finally:
        for worker in workers:
            worker.leave()
        for thread in threads:
            thread.join()


@pytest.fixture(scope="module")
def driven() -> Solver:
    """With a map that takes long to eliminate as a whole."""
    solver = Solver(Options())
    for step in manhattan(POSES, 5):
        solver.stage(step.batch)
        solver.step()
    return solver


def numbers(solver: Solver) -> list[bytes]:
    """All that an elimination fills in."""
    tree = tree_of(solver)
    used = {"numbers": int(tree.state[tl.S_NUMBERS]), "clique": int(tree.state[tl.S_CLIQUES])}
    arrays = [tree.numbers[fr.SCRATCH : used["numbers"]], tree.clique[: used["clique"]], tree.scalars]
    return [np.ascontiguousarray(array).tobytes() for array in arrays]


def eliminated(driven: Solver) -> tuple[list[bytes], float]:
    """The numbers of a new solver, and flops."""
    solver = Solver(Options())
    flops = solver.renew(driven, driven.variable_count, driven.factor_count).flops
    return numbers(solver), flops


@pytest.mark.parametrize(("p", "m"), [(70, 420), (130, 401), (300, 300), (700, 3), (500, 0)])
@pytest.mark.parametrize("count", [1, 3])
def test_a_front_has_the_same_bits(p: int, m: int, count: int) -> None:
    expected = factorized(p, m)
    with working(count) as workers:
        while not any(worker.made for worker in workers):
            assert factorized(p, m) == expected
    assert factorized(p, m) == expected


def factorized(p: int, m: int) -> bytes:
    """A front, zeros between what is its own."""
    rng, lead, ld, width = (
        np.random.default_rng(p),
        -p % fr.LANES,
        fr.padded_size(p) + fr.padded_size(m),
        fr.padded_size(m),
    )
    start = fr.SCRATCH + p * ld
    arena = np.zeros(start + fr.update_size(m, width) + fr.LANES)
    rows = arena[fr.SCRATCH : start].reshape(p, ld)[:, lead : lead + p + m]
    rows[:] = rng.normal(size=(p, p + m))
    rows[:, :p] = np.triu(rows[:, :p] @ rows[:, :p].T + (p + m) * np.eye(p))
    front = fr.Front(fr.SCRATCH + lead, ld, p, m, start, width)
    assert factor_front(arena, front, np.zeros(p), 0, TASK_QUEUE) == -1
    return arena[fr.SCRATCH :].tobytes()


@pytest.mark.parametrize("count", [1, MOST])
def test_a_whole_map_has_the_same_bits(driven: Solver, count: int) -> None:
    alone = eliminated(driven)
    with working(count) as workers:
        while not any(worker.made for worker in workers):
            assert eliminated(driven) == alone
    assert eliminated(driven) == alone


def grid(side: int) -> tuple[Symbolic, np.ndarray, np.ndarray]:
    """Λ of a grid of points, three numbers each, that hold to their neighbours: its analysis, blocks and offsets."""
    at, dims = np.arange(side * side).reshape(side, side), np.full(side * side, 3)
    pairs = np.concatenate(
        [np.stack((a.ravel(), b.ravel())) for a, b in ((at[1:], at[:-1]), (at[:, 1:], at[:, :-1]))], 1
    )
    rows = np.concatenate((at.ravel(), pairs.min(0)))
    cols = np.concatenate((at.ravel(), pairs.max(0)))
    data = np.random.default_rng(side).normal(size=(rows.size, 3, 3))
    data[: at.size] = 30.0 * np.eye(3)
    symbolic = analyze(dims, rows, cols, order(dims, rows, cols, None))
    return symbolic, data.ravel(), 9 * np.arange(rows.size)


@pytest.fixture(scope="module")
def plane() -> tuple[Symbolic, np.ndarray, np.ndarray]:
    return grid(60)


@pytest.mark.parametrize("count", [1, 3, MOST])
def test_a_whole_graph_has_the_same_bits(plane: tuple[Symbolic, np.ndarray, np.ndarray], count: int) -> None:
    """Subtrees and panels of it, on several cores; and it is R of Λ."""
    symbolic, data, offsets = plane
    assert len(cut_whole(symbolic.fronts)) > 1
    eta = np.random.default_rng(1).normal(size=symbolic.size)

    def solved() -> bytes:
        cholesky = Cholesky()
        assert cholesky.factorize(symbolic, data, offsets) == -1
        return cholesky.solve(eta).tobytes()

    alone = solved()
    with working(count) as workers:
        while not any(worker.made for worker in workers):
            assert solved() == alone
    cholesky = Cholesky()
    cholesky.factorize(symbolic, data, offsets)
    R, places = cholesky.R(), symbolic.scalar_order()
    np.testing.assert_allclose(R.T @ (R @ np.frombuffer(alone)[places]), eta[places], atol=1e-9)


@pytest.mark.parametrize("count", [0, 2])
def test_the_same_pivot_fails_whoever_comes_to_it(count: int) -> None:
    """Of several, in the order of elimination."""
    symbolic, data, offsets = grid(60)
    bad = symbolic.order[[700, 1500, 2900, 3599]]
    for n in range(len(bad), 0, -1):
        spoilt = data.copy()
        for variable in bad[len(bad) - n :]:
            spoilt[offsets[variable] + 4] = -1.0
        with working(count):
            for _ in range(5):
                assert Cholesky().factorize(symbolic, spoilt, offsets) == bad[len(bad) - n]


def test_a_drive_has_the_same_bits() -> None:
    def drive() -> tuple[list[bytes], list[int]]:
        solver, flops = Solver(Options()), []
        for step in manhattan(2 * POSES, 7):
            solver.stage(step.batch)
            flops.append(solver.step().flops)
        solver.step(settle=True)
        return numbers(solver), flops

    alone = drive()
    with working() as (worker,):
        while not worker.made:
            assert drive() == alone


def test_maps_that_are_eliminated_at_once_share_the_cores(driven: Solver) -> None:
    alone, found = eliminated(driven), []
    with working() as (worker,):
        while not worker.made:
            threads = [threading.Thread(target=lambda: found.append(eliminated(driven))) for _ in range(3)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
    assert len(found) >= 3
    assert all(each == alone for each in found)


def loose(ends: list[int]) -> Batch:
    """At each of these poses hang two new ones, tied to each other 10¹⁶ times as well as to it."""
    first = np.array([-100 - 2 * n for n in range(len(ends))])
    keys = np.concatenate([np.column_stack([ends, first]), np.column_stack([first, first - 1])])
    information = np.repeat([1.0, 1e16], len(ends))[:, None] * [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]
    return Batch(
        (Variables("se2", np.concatenate([first, first - 1])),),
        (Factors("between_se2", keys, np.tile([1.0, 0.0, 0.5], (len(keys), 1)), information),),
    )


def test_pivots_below_rounding_are_raised_alike() -> None:
    def taken() -> bytes:
        solver = Solver(Options())
        for step in manhattan(POSES, 5):
            solver.stage(step.batch)
        solver.stage(loose([POSE + 200 * n for n in range(7)]))
        assert solver.step().chi2 < 1e6
        return b"".join(group.values.tobytes() for group in solver.estimate())

    alone = taken()
    with working() as (worker,):
        while not worker.made:
            assert taken() == alone


def test_who_leaves_is_no_longer_there_and_makes_room_for_others(driven: Solver) -> None:
    alone, free = eliminated(driven), count_free()
    for _ in range(2 * MOST):
        with working(2) as workers:
            assert count_free() == free - 2
        assert count_free() == free
    made = [worker.made for worker in workers]
    assert eliminated(driven) == alone
    assert [worker.made for worker in workers] == made


def test_there_is_room_for_so_many_and_no_more() -> None:
    with working(count_free()), pytest.raises(ValueError, match=f"{MOST} worker threads"):
        WorkerThread()


@given(st.lists(st.tuples(st.integers(1, 300), st.integers(0, 600)), max_size=60), st.data(), st.integers(1, 3))
def test_what_is_cut_off_is_whole_subtrees_of_a_small_share(sizes: list, data: st.DataObject, workers: int) -> None:
    records = np.zeros((len(sizes), fr.FRONT), np.int64)
    records[:, fr.PARENT] = -1
    # Postorder: who comes next takes some of the last roots as children.
    roots: list[int] = []
    for f, (p, m) in enumerate(sizes):
        records[f, fr.PIVOTS], records[f, fr.SEPARATOR] = p, m
        for _ in range(data.draw(st.integers(0, min(len(roots), 3)))):
            records[roots.pop(), fr.PARENT] = f
        roots.append(f)
    cut = cut_subtrees(records, workers)
    takes = [(p + ASSEMBLY) * (p + m + 1) ** 2 + BOOKKEEPING for p, m in sizes]
    if sum(takes) < LONG:
        assert len(cut) == 0
        return
    most, above = sum(takes) / (PIECES * (1 + workers)), records[:, fr.PARENT]
    inside = np.full(len(sizes), -1)
    for k, (first, end) in enumerate(cut[:, [FIRST, END]]):
        assert (inside[first:end] == -1).all()
        inside[first:end] = k
        assert sum(takes[first:end]) <= most
    for f, parent in enumerate(above):
        if parent >= 0:
            assert inside[f] == inside[parent] or inside[parent] == -1
    assert (np.diff(cut[:, FIRST]) > 0).all()
    turns = [sum(takes[first:end]) for first, end in cut[cut[:, TURN]][:, [FIRST, END]]]
    assert turns == sorted(turns, reverse=True)
    assert sorted(cut[:, TURN]) == list(range(len(cut)))
