"""Sets of closures that agree, and what hangs together by odometry, against what they are by definition."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.closure_sets import chain_of, every_largest, held_members, places_of

from examples import examples
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver.closures.choosing import closure_places
from factorbus.solver.closures.loops import TrustedForest
from factorbus.solver.kernels.closures.sets import (
    N_ALONE,
    N_AMONG,
    N_BETWEEN,
    N_PLACES,
    list_believed,
    list_largest,
    list_rivals,
    put_pairs,
)
from factorbus.solver.kernels.jit.compile import F64

_WITHIN = 10.0
seeds = st.integers(0, 2**32 - 1)


def moved(places: F64) -> F64:
    T = np.tile(np.eye(3), (len(places), 1, 1))
    T[:, :2, 2] = places
    return T


@examples(100)
@given(seed=seeds, n=st.integers(2, 9), most=st.sampled_from([1e-3, 0.02, 0.3]))
def test_a_set_is_what_its_definition_says(seed: int, n: int, most: float) -> None:
    rng = np.random.default_rng(seed)
    i, j = np.triu_indices(n, 1)
    distance, chance = rng.exponential(4.0, i.size), 10.0 ** rng.uniform(-6.0, 0.0, (i.size, 2))
    agree, chances = np.empty((n, n), bool), (np.empty((2, n, n)), np.empty((2, n, n)))
    put_pairs(i, j, distance, 8.0, (chance, np.log(chance)), agree, chances)
    assert (agree == agree.T).all()
    assert agree[i, j].tolist() == (distance <= 8.0).tolist()
    assert not agree.diagonal().any()
    np.testing.assert_array_equal(chances[1], np.log(chances[0]))
    alone, centres = 10.0 ** rng.uniform(-5.0, 0.0, n), rng.uniform(0.0, 60.0, (2, 3, 2))
    at = rng.integers(0, 3, n)
    a, b = (moved(each[at] + rng.normal(0.0, 3.0, (n, 2))) for each in centres)
    among = np.sort(rng.choice(n, rng.integers(2, n + 1), replace=False))
    members, numbers = np.empty(among.size, np.int64), np.empty(N_BETWEEN + 2 * among.size)

    count = list_largest(agree, among, members)
    largest = members[:count].copy()
    wanted = [tuple(among[list(some)].tolist()) for some in every_largest(agree[np.ix_(among, among)])]
    assert tuple(largest.tolist()) in wanted

    table = np.moveaxis(chances[0], 0, -1)
    count = list_rivals(agree, among, chances[1], members, numbers)
    assert members[:count].tolist() == largest.tolist()
    own = table[np.ix_(largest, largest)][..., 0]
    assert numbers[: max(count - 1, 0)].sum() == pytest.approx(chain_of(own) if count else 0.0)

    count = list_believed(agree, among, chances, alone, (a, b), (0.5, most, _WITHIN), members, numbers)
    found, places, least, between = held_members(largest, table, alone, (a, b, _WITHIN), most, 0.5)
    assert members[:count].tolist() == found.tolist()
    if count:
        there = np.unique(places).size
        assert numbers[N_PLACES] == there
        assert numbers[N_AMONG] == np.unique(places_of(a[among], b[among], _WITHIN)).size
        assert numbers[N_ALONE] == pytest.approx(least)
        trees = numbers[N_BETWEEN : N_BETWEEN + there + count - 2]
        assert trees[: there - 1].sum() == pytest.approx(chain_of(between))
        assert trees[there - 1 :].sum() == pytest.approx(chain_of(table[np.ix_(found, found)][..., 0]))


@examples(50)
@given(seed=seeds, n=st.integers(0, 8), share=st.floats(0.2, 0.9))
def test_the_largest_set_is_one_that_trying_everything_finds(seed: int, n: int, share: float) -> None:
    agree = np.triu(np.random.default_rng(seed).random((n, n)) < share, 1)
    agree |= agree.T
    members = np.empty(n, np.int64)
    assert tuple(members[: list_largest(agree, np.arange(n), members)].tolist()) in every_largest(agree)


@examples(50)
@given(seed=seeds, n=st.integers(0, 12))
def test_places_are_those_of_the_first_that_is_near(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = moved(rng.uniform(0.0, 40.0, (n, 2))), moved(rng.uniform(0.0, 40.0, (n, 2)))
    assert closure_places(a, b, _WITHIN).tolist() == places_of(a, b, _WITHIN).tolist()


class Joined:
    """Parts of keys, merged one by one."""

    def __init__(self) -> None:
        self.part: dict[object, set[object]] = {}

    def join(self, i: object, j: object) -> None:
        merged = self.part.get(i, {i}) | self.part.get(j, {j})
        self.part |= dict.fromkeys(merged, merged)

    def are(self, i: object, j: object) -> bool:
        return j in self.part.get(i, {i})


_STEPS = st.lists(
    st.tuples(
        st.sampled_from(["next", "before", "two", "closure", "trusted", "fixed", "join", "refused"]),
        st.integers(0, 40),
        st.integers(0, 40),
    ),
    max_size=60,
)


def odometry(*rows: tuple[int, int]) -> Factors:
    n = len(rows)
    return Factors("between_se2", np.array(rows, np.int64).reshape(n, 2), np.zeros((n, 3)), np.ones((n, 6)))


@examples(200)
@given(steps=_STEPS)
def test_chains_of_odometry_join_what_joining_key_by_key_does(steps: list[tuple[str, int, int]]) -> None:
    made, wanted, newest = TrustedForest(), Joined(), {0: 0, 1: 100}
    for what, i, j in steps:
        fixed, trusted, rows = [], False, list[tuple[int, int]]()
        robot = i % 2
        last = newest[robot]
        if what in ("next", "join", "refused"):
            rows = [(last, last + 1)] + ([(last, last - j)] if j > 1 and what == "next" else [])
            rows += [(i, j + 100)] * (what == "refused")
            newest[robot] += what != "refused"
        elif what == "before":
            rows = [(last + 1, last)]
        elif what == "two":
            rows = [(last, last + 1), (last + 1, last + 2)]
            newest[robot] += 2
        elif what == "fixed":
            fixed = [i + 100 * (j % 2)]
        elif i != j:
            rows, trusted = [(i, j + 100 * (j % 3 == 0))], what == "trusted"
        group = odometry(*rows)._replace(trusted=trusted)
        variables = (Variables("se2", np.array(fixed), np.zeros((1, 3)), True),) if fixed else ()
        batch = Batch(variables, (group,) if rows else ())
        if what == "refused":
            made.split(batch)
            made.forget()
            continue
        for key in fixed:
            wanted.join("ground", key)
        if what == "join":
            made.join(batch)
            wanted.join(*rows[0])
            continue
        closing = [(r, s) for r, s in rows if not trusted and abs(r - s) != 1]
        for r, s in rows:
            if (r, s) not in closing:
                wanted.join(r, s)
        expected = []
        for r, s in closing:
            if wanted.are(r, s):
                expected.append((r, s))
            wanted.join(r, s)
        split = made.split(batch)
        assert [tuple(c.keys[0].tolist()) for c in split.closing] == expected
        assert split.kind == ("between_se2" if expected else "")
    kept = TrustedForest()
    kept.load(made.dump())
    for r, s in itertools.combinations([*range(0, 44, 3), *range(100, 144, 3)], 2):
        if abs(r - s) > 1 and r in wanted.part and s in wanted.part:
            assert bool(kept.split(Batch((), (odometry((r, s)),))).closing) == wanted.are(r, s)
            wanted.join(r, s)
