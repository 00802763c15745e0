"""Into how many shards a question goes, where it is cut, and when the way to a worker pays."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.proto.features import Ask, Segment, answer_size
from factorbus.proto.features_codec import encode_shard_done
from factorbus.service.jobs.rates import example, measured
from factorbus.service.jobs.sharding import Rates, RoundTrip, Work, cuts, seconds, shards_for, work_of

RATES = Rates(fixed_s=1e-4, feature_s=1e-7, number_s=2e-9, stored_s=1e-9)
ROUND_TRIP = RoundTrip(fixed_s=3e-4, byte_s=1e-9)


def stored(n: int) -> Ask:
    return example("rows", n)._replace(segment=Segment(0, 0, "", 0, 0))


def test_without_workers_it_is_done_in_place() -> None:
    assert shards_for(work_of(stored(1000)), RATES, [], 0) == 0
    assert shards_for(work_of(stored(1000)), RATES, [ROUND_TRIP], 0) == 0


def test_the_way_pays_when_it_is_shorter_than_the_work() -> None:
    counts = [shards_for(work_of(stored(n)), RATES, [ROUND_TRIP], 2) for n in (1, 10, 30, 100, 1000)]
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, 2)
    for n in (20, 30, 50, 70, 100):
        work = work_of(stored(n))
        way = ROUND_TRIP.fixed_s + ROUND_TRIP.byte_s * work.bytes_back
        assert (shards_for(work, RATES, [ROUND_TRIP], 1) > 0) == (way < seconds(work, RATES))


def test_an_answer_that_takes_longer_to_send_than_to_make_is_made_here() -> None:
    slow = RoundTrip(fixed_s=1e-4, byte_s=5e-9)
    assert shards_for(work_of(example("half", 1000)), RATES, [slow], 4) == 0
    assert shards_for(work_of(stored(1000)), RATES, [slow], 4) == 4


def test_more_workers_take_more_shards_but_not_more_than_features_or_slots() -> None:
    assert [shards_for(work_of(stored(1000)), RATES, [ROUND_TRIP], slots) for slots in (1, 2, 7)] == [1, 2, 7]
    many = Work(features=3, bytes_back=0, numbers=10**9, stored=True)
    assert shards_for(many, RATES, [ROUND_TRIP], 7) == 3


def test_the_slowest_way_counts() -> None:
    work = work_of(stored(100))
    assert shards_for(work, RATES, [ROUND_TRIP], 2) == 2
    assert shards_for(work, RATES, [ROUND_TRIP, RoundTrip(1.0, 0.0)], 2) == 0


@given(st.integers(1, 300), st.integers(1, 12), st.sampled_from(["rows", "half", "factored"]))
def test_shards_are_all_features_once_in_order_and_alike_in_work(n: int, count: int, form: str) -> None:
    ask = example(form, n)
    shards = cuts(ask, min(count, n))
    assert [first for first, _ in shards] == [0, *(last for _, last in shards[:-1])]
    assert shards[-1][1] == n
    assert all(first < last for first, last in shards)
    if form == "half":
        weight = np.array([6 * 13 + 36 * (n - i) for i in range(n)])
        shares = [weight[first:last].sum() for first, last in shards]
        assert max(shares) <= weight.sum() / min(count, n) + 2 * weight[0]
    else:
        assert max(last - first for first, last in shards) <= -(-n // min(count, n))


@pytest.mark.parametrize("form", ["rows", "half", "factored"])
def test_the_size_of_an_answer_is_known_before_it_is_computed(form: str) -> None:
    from factorbus.idp import job
    from factorbus.proto.features import Shard
    from factorbus.proto.features_codec import encode_ask

    ask = example(form, 40)
    answer = job.done(Shard(encode_ask(ask), 0, 40), ask)
    assert 0 < len(encode_shard_done(answer)) - answer_size(ask) < 200


def test_this_machine_is_measured() -> None:
    rates = measured()
    assert rates.fixed_s > 0.0
    assert rates.feature_s >= 0.0
    assert rates.number_s > 0.0
    few, many = (seconds(work_of(example("half", n)), rates) for n in (2, 2000))
    assert many > 10 * few


def test_edges_follow_each_other() -> None:
    assert all(a[1] == b[0] for a, b in pairwise(cuts(example("half", 50), 4)))
