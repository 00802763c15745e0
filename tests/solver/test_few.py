"""Order and fronts of few affected variables, MATH §9.4: exact minimum degree, and the fronts that many would have."""

from dataclasses import dataclass

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from naive.records import graph_of, tree_of

from factorbus.solver.graph.variables import VARIABLE_KINDS
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.fronts import analyze_affected
from factorbus.solver.kernels.bayes_tree.order import NEWEST, find_lowest, list_pairs, order_affected
from factorbus.solver.kernels.bayes_tree.order_small import PLANES, analyze_few, join_few, order_few
from factorbus.solver.kernels.jit.bit_sets import MOST, count_bits, highest_bit, lowest_bit
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.jit.scratch import WORDS
from factorbus.solver.kernels.model import layout as at

STAMP, STEP, RECENT, FIRST = 7, 20, 5, 3  # variables of the map before the first that is affected
KINDS = {at.POINT2: 2, at.SE2: 3, at.SE3: 6}


@part
def look_at_bits(word: int) -> tuple[int, int, int]:
    """How many, the first and the last."""
    return count_bits(word), lowest_bit(word), highest_bit(word)


@given(st.sets(st.integers(0, MOST - 1), min_size=1))
def test_bits(found: set[int]) -> None:
    assert look_at_bits(sum(1 << k for k in found)) == (len(found), min(found), max(found))


def test_there_are_planes_for_all_kinds() -> None:
    assert all(kind.dim < 1 << PLANES for kind in VARIABLE_KINDS.values())


@dataclass(frozen=True)
class Affected:
    """Affected variables: their kinds and groups, pairs that factors join, and separators of orphans."""

    kinds: list[int]
    groups: list[int]
    pairs: list[tuple[int, int]]
    hung: list[list[int]]

    @property
    def dims(self) -> list[int]:
        """Scalars of each."""
        return [KINDS[kind] for kind in self.kinds]

    def neighbours(self) -> list[set[int]]:
        """Who is next to whom."""
        found: list[set[int]] = [set() for _ in self.kinds]
        for clique in (*self.pairs, *self.hung):
            for i in clique:
                found[i] |= set(clique) - {i}
        return found

    def arrays(self) -> dict[str, I64]:
        """As a map has them: the affected variables are its last ones, and each orphan has one frontal."""
        n, m, behind = len(self.kinds), len(self.pairs), len(self.hung)
        var, node = np.zeros((FIRST + n, at.V_WIDTH), np.int64), np.zeros((FIRST + n, tl.N_WIDTH), np.int64)
        var[FIRST:, at.V_KIND], node[FIRST:, tl.N_LOCAL] = self.kinds, range(n)
        for v, group in enumerate(self.groups, FIRST):
            node[v, tl.N_SEEN] = STEP if group == NEWEST - 1 else 0
            if 0 < group < NEWEST - 1:
                node[v, [tl.N_NEAR, tl.N_RING]] = STAMP, group - 1
        fac = np.full((m + 1, at.F_WIDTH), -1, np.int64)
        for f, (i, j) in enumerate(self.pairs):
            fac[f, [at.F_I, at.F_J]] = FIRST + i, FIRST + j
        fac[m, at.F_I] = FIRST  # of one variable
        clique, lists = np.zeros((behind, tl.C_WIDTH), np.int64), []
        for e, separator in enumerate(self.hung):
            clique[e, [tl.C_LIST, tl.C_FRONTALS, tl.C_SEPARATORS]] = len(lists), 1, len(separator)
            lists += [0, *(FIRST + k for k in separator)]
        state = np.zeros(tl.S_SIZE, np.int64)
        state[tl.S_STAMP], state[tl.S_STEP] = STAMP, STEP
        return {
            "affected": np.arange(FIRST, FIRST + n),
            "factors": np.arange(m + 1),
            "orphans": np.arange(behind),
            "var": var,
            "fac": fac,
            "node": node,
            "clique": clique,
            "lists": np.array(lists, np.int64),
            "state": state,
        }


@st.composite
def affected(draw: st.DrawFn) -> Affected:
    n = draw(st.integers(2, MOST))
    seed = np.random.default_rng(draw(st.integers(0, 2**32)))
    groups = draw(st.sampled_from([[0], [0, 0, NEWEST - 1], [0, 1, 2, NEWEST - 1]]))
    pairs = [(k, k + 1) for k in range(n - 1) if seed.random() < 0.9]  # a drive, mostly
    pairs += [tuple(seed.choice(n, 2, replace=False).tolist()) for _ in range(draw(st.integers(0, n)))]
    width = min(n, 6)
    hung = [seed.choice(n, seed.integers(1, width + 1), replace=False).tolist() for _ in range(draw(st.integers(0, 8)))]
    kinds = seed.choice(list(KINDS), n) if draw(st.booleans()) else np.full(n, at.SE2)
    return Affected(kinds.tolist(), seed.choice(groups, n).tolist(), pairs, hung)


def ordered(few: Affected, last: int = -1) -> tuple[I64, I64, I64, I64, dict[str, I64]]:
    """What `order_few` gives, and the orphans' separators."""
    a = few.arrays()
    n = len(few.kinds)
    near, hung = join_few(graph_of(a), tree_of(a), n, a["factors"], a["orphans"])
    perm, row, planes = order_few(near, a["affected"], RECENT, last, a["var"], tree_of(a))
    return perm, row, planes, hung, a


@given(affected(), st.booleans())
def test_pivots_have_the_least_degree_of_their_group_and_are_the_last_beside_the_last_one(
    few: Affected, drives_on: bool
) -> None:
    last = len(few.kinds) - 1 if drives_on else -1
    perm, row, _, hung, _ = ordered(few, FIRST + last if drives_on else -1)
    groups = [NEWEST if k == last else group for k, group in enumerate(few.groups)]
    graph, left, beside = few.neighbours(), set(range(len(few.kinds))), set[int]()
    assert [members(word) for word in hung.tolist()] == [set(separator) for separator in few.hung]
    for k, me in enumerate(perm.tolist()):
        group = min(groups[i] for i in left)
        degree = {i: sum(few.dims[j] for j in graph[i]) for i in left if groups[i] == group}
        least = {i for i in degree if degree[i] == min(degree.values())}
        assert me == max(least & beside or least)
        assert members(int(row[k])) == graph[me]
        beside = set(graph[me])
        for i in graph[me]:
            graph[i] = (graph[i] | graph[me]) - {i, me}
        left.remove(me)
    assert not left


@given(affected())
def test_fronts_are_those_that_many_variables_have(few: Affected) -> None:
    perm, row, planes, hung, a = ordered(few)
    fronts, found_lowest = analyze_few(perm, row, planes, hung, a["affected"], a["var"], np.ones(WORDS, np.int64))
    label = np.argsort(perm)
    lowest = find_lowest(label, a["orphans"], tree_of(a))
    rows, cols = list_pairs(graph_of(a), tree_of(a), lowest, a["factors"], a["orphans"])
    wanted = analyze_affected(perm, a["affected"], a["var"], rows, cols, np.ones(1, np.int64))
    np.testing.assert_array_equal(found_lowest, lowest)
    for one, other in zip(fronts, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


@given(affected())
def test_fill_is_near_that_of_many_variables(few: Affected) -> None:
    a = few.arrays()
    other = order_affected(
        graph_of(a), tree_of(a), len(few.kinds), a["affected"], a["factors"], a["orphans"], RECENT, -1
    )
    assert fill(few, ordered(few)[0]) <= 1.25 * fill(few, other) + 50


def members(word: int) -> set[int]:
    return {k for k in range(MOST) if word >> k & 1}


def fill(few: Affected, perm: I64) -> int:
    """Nonzeros of R, diagonal blocks whole."""
    graph, total = few.neighbours(), 0
    for me in perm.tolist():
        total += few.dims[me] * (few.dims[me] + sum(few.dims[i] for i in graph[me]))
        for i in graph[me]:
            graph[i] = (graph[i] | graph[me]) - {i, me}
    return total
