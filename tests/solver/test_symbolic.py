"""The analysis against elimination by sets."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.block_systems import BlockSystem, grid, random_system, systems
from naive.elimination import row_lengths

from factorbus.solver.kernels.sparse import fronts as fr
from factorbus.solver.sparse.ordering import order
from factorbus.solver.sparse.symbolic import Symbolic, analyze


@st.composite
def analyses(draw: st.DrawFn) -> tuple[BlockSystem, np.ndarray, Symbolic]:
    system = draw(systems())
    perm = np.array(draw(st.permutations(range(len(system.dims)))), np.int64)
    return system, perm, analyze(system.dims, system.rows, system.cols, perm)


@given(analyses())
def test_nonzeros_and_flops_are_those_of_elimination(analysis):
    system, perm, symbolic = analysis
    lengths = row_lengths(system, perm)
    assert symbolic.nnz_r == lengths.sum()
    assert symbolic.flops == (lengths.astype(float) ** 2).sum()


@given(analyses())
def test_the_order_is_another_one_of_the_same_tree(analysis):
    system, perm, symbolic = analysis
    assert sorted(symbolic.order) == sorted(perm)
    assert row_lengths(system, symbolic.order).sum() == row_lengths(system, perm).sum()
    assert sorted(symbolic.scalar_order()) == list(range(symbolic.size))
    for v, dim in enumerate(system.dims.tolist()):
        for scalar in range(dim):
            assert symbolic.variable_at(int(symbolic.place[v]) + scalar) == v


@given(analyses())
def test_fronts_form_a_forest_in_postorder(analysis):
    _, _, symbolic = analysis
    fronts = symbolic.fronts
    assert fronts[:, fr.PIVOTS].sum() == symbolic.size
    assert np.array_equal(fronts[:, fr.COLUMN], np.cumsum(fronts[:, fr.PIVOTS]) - fronts[:, fr.PIVOTS])
    children = [[] for _ in fronts]
    for f, front in enumerate(fronts):
        above, separator = front[fr.PARENT], separator_of(symbolic, front)
        assert (above < 0) == (len(separator) == 0) or above > f
        if above >= 0:
            assert above > f
            children[above].append(f)
            assert set(separator) <= set(columns_of(symbolic, fronts[above]))
    for f, front in enumerate(fronts):
        linked, c = [], front[fr.CHILD]
        while c >= 0:
            linked.append(c)
            c = fronts[c, fr.SIBLING]
        assert linked == children[f]


@given(analyses())
def test_runs_lead_each_border_scalar_to_itself_in_the_parent(analysis):
    _, _, symbolic = analysis
    for front in symbolic.fronts:
        if front[fr.PARENT] < 0:
            continue
        above = symbolic.fronts[front[fr.PARENT]]
        separator, columns, covered = separator_of(symbolic, front), columns_of(symbolic, above), 0
        for first, count, into in symbolic.runs[front[fr.RUNS] : front[fr.RUNS_END]]:
            assert first == covered
            assert list(columns[into : into + count]) == list(separator[first : first + count])
            assert into >= above[fr.PIVOTS] or into + count <= above[fr.PIVOTS]
            covered += count
        assert covered == len(separator)


@given(analyses())
def test_no_two_living_numbers_share_a_place(analysis):
    """Rows of R for ever; an update matrix from the making of its front to that of the parent."""
    _, _, symbolic = analysis
    taken = np.zeros(symbolic.arena, np.int64)
    taken[: fr.SCRATCH] = 1
    for front in symbolic.fronts:
        p, m = front[fr.PIVOTS], front[fr.SEPARATOR]
        lead = fr.padded_size(p) - p
        rows = slice(front[fr.ROWS] - lead, front[fr.ROWS] - lead + p * front[fr.LD_ROWS])
        update = slice(front[fr.UPDATE], front[fr.UPDATE] + fr.update_size(m, front[fr.WIDTH_UPDATE]))
        assert rows.stop <= symbolic.stored <= update.start
        assert lead + p + fr.padded_size(m) <= front[fr.LD_ROWS]
        assert not taken[rows].any()
        assert not taken[update].any()
        taken[rows], taken[update] = 1, 1
        c = front[fr.CHILD]
        while c >= 0:
            child = symbolic.fronts[c]
            size = fr.update_size(child[fr.SEPARATOR], child[fr.WIDTH_UPDATE])
            place = slice(child[fr.UPDATE], child[fr.UPDATE] + size)
            assert taken[place].all()
            taken[place] = 0
            c = child[fr.SIBLING]
    assert not taken[symbolic.stored :].any()


def test_a_chain_does_not_collapse_into_one_front():
    """Joining without counting the zeros of earlier joins would."""
    chain = random_system(1, [3] * 1000, [(v, v + 1) for v in range(999)])
    symbolic = analyze(chain.dims, chain.rows, chain.cols, np.arange(1000))
    assert symbolic.fronts[:, fr.PIVOTS].max() <= 60
    assert symbolic.stored <= 12 * symbolic.nnz_r


def test_joined_fronts_hold_few_zeros():
    system = grid(40)
    symbolic = analyze(system.dims, system.rows, system.cols, order(system.dims, system.rows, system.cols))
    p, m = symbolic.fronts[:, fr.PIVOTS], symbolic.fronts[:, fr.SEPARATOR]
    assert symbolic.nnz_r <= (p * (p + 1) // 2 + p * m).sum() <= 1.25 * symbolic.nnz_r
    assert len(symbolic.fronts) < 0.6 * len(system.dims)


@pytest.mark.parametrize("dims", [[], [3], [7]])
def test_hardly_anything(dims):
    system = random_system(0, dims, [])
    symbolic = analyze(system.dims, system.rows, system.cols, np.arange(len(dims)))
    assert symbolic.nnz_r == sum(d * (d + 1) // 2 for d in dims)
    assert len(symbolic.fronts) == len(dims)


@pytest.mark.parametrize("perm", [[0], [0, 0], [0, 2], [-1, 0], [0, 1, 2]])
def test_an_order_that_is_no_permutation_is_refused(perm):
    system = random_system(0, [3, 2], [(0, 1)])
    with pytest.raises(ValueError, match="not a permutation of 0 to 1"):
        analyze(system.dims, system.rows, system.cols, np.array(perm))


def test_a_missing_diagonal_block_is_refused():
    with pytest.raises(ValueError, match="variable 1 has no diagonal block"):
        analyze(np.array([3, 2]), np.array([0, 0]), np.array([0, 1]), np.array([0, 1]))


def separator_of(symbolic: Symbolic, front: np.ndarray) -> np.ndarray:
    return symbolic.separator[front[fr.SEPARATOR_AT] : front[fr.SEPARATOR_AT] + front[fr.SEPARATOR]]


def columns_of(symbolic: Symbolic, front: np.ndarray) -> np.ndarray:
    pivots = np.arange(front[fr.COLUMN], front[fr.COLUMN] + front[fr.PIVOTS])
    return np.concatenate((pivots, separator_of(symbolic, front)))
