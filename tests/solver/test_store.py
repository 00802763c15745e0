"""Memory of the tree: every double belongs to one block, in use or free; and what a drive leaves free is used again."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from naive.tree_records import tree_of

from examples import examples
from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver
from factorbus.solver.bayes_tree.tree import CliqueTree
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.allocator import (
    FOLLOWING,
    SIZE,
    give_numbers,
    join_free,
    take_numbers,
)
from factorbus.solver.kernels.sparse import fronts as fr

ROOM = 1 << 16


def free_blocks(numbers: np.ndarray, state: np.ndarray) -> list[tuple[int, int]]:
    """(start, size) of all blocks on the free lists of `numbers`."""
    found = []
    for kind in range(tl.CLASSES):
        block = int(state[tl.S_FREE + kind])
        while block:
            found.append((block - 1, int(numbers[block - 1 + SIZE])))
            block = int(numbers[block - 1 + FOLLOWING])
    return found


def check_tiling(used: list[tuple[int, int]], numbers: np.ndarray, state: np.ndarray) -> None:
    """Blocks in use and free ones lie side by side from the scratch to the end of what is in use."""
    free = free_blocks(numbers, state)
    end = fr.SCRATCH
    for start, size in sorted([*used, *free]):
        assert start == end
        assert size > 0
        end += size
    assert end == state[tl.S_NUMBERS]
    assert sum(size for _, size in free) == state[tl.S_IDLE]


@examples(200)
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 700)), max_size=80))
def test_blocks_never_overlap(wanted: list[tuple[bool, int]]) -> None:
    numbers, state = np.zeros(ROOM), np.zeros(tl.S_SIZE, np.int64)
    state[tl.S_NUMBERS] = fr.SCRATCH
    used: list[tuple[int, int]] = []
    for takes, size in wanted:
        if takes or not used:
            start, rounded = take_numbers(size, numbers, state)
            assert size <= rounded <= max(1.25 * size, size + 8)
            numbers[start : start + rounded] = np.nan
            used.append((int(start), int(rounded)))
        else:
            give_numbers(*used.pop(size % len(used)), numbers, state)
        check_tiling(used, numbers, state)
    for block in used:
        give_numbers(*block, numbers, state)
    join_free(numbers, state)
    assert state[tl.S_NUMBERS] == fr.SCRATCH
    assert state[tl.S_IDLE] == 0


def test_neighbours_that_are_free_serve_a_larger_request() -> None:
    numbers, state = np.zeros(ROOM), np.zeros(tl.S_SIZE, np.int64)
    state[tl.S_NUMBERS] = fr.SCRATCH
    blocks = [take_numbers(64, numbers, state) for _ in range(64)]
    for block in blocks[:-1]:
        give_numbers(*block, numbers, state)
    before = int(state[tl.S_NUMBERS])
    assert take_numbers(60 * 64, numbers, state)[0] == blocks[0][0]
    assert state[tl.S_NUMBERS] == before


def blocks_of(tree: CliqueTree) -> list[tuple[int, int]]:
    """(start, size) of the blocks of all cliques."""
    gone, c = set[int](), int(tree.state[tl.S_FREE_CLIQUE])
    while c >= 0:
        gone.add(c)
        c = int(tree.clique[c, tl.C_NEXT])
    rows = [row for c, row in enumerate(tree.clique[: tree.state[tl.S_CLIQUES]].tolist()) if c not in gone]
    return [
        (row[start], row[size])
        for row in rows
        for start, size in ((tl.C_BLOCK, tl.C_BLOCK_SIZE), (tl.C_UPDATE, tl.C_UPDATE_BLOCK_SIZE))
    ]


def test_what_a_drive_leaves_free_is_used_again() -> None:
    solver = Solver(Options())
    tree, most = tree_of(solver), 0.0
    for n, step in enumerate(manhattan(4000, 3), start=1):
        solver.stage(step.batch)
        solver.step()
        if n % 500 == 0:
            used = blocks_of(tree)
            check_tiling(used, tree.numbers, tree.state)
            most = (int(tree.state[tl.S_NUMBERS]) - fr.SCRATCH) / sum(size for _, size in used)
    # A relinearization of everything has the old and the new at once, which are two.
    assert most < 2.1
    kept = solver.dump()["_stepper"]["_tree"]["numbers"]
    assert kept.size == tree.state[tl.S_NUMBERS] < tree.numbers.size
