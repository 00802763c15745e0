"""The client's side of features: what comes back put together, shared memory used again, what cannot be believed."""

import gc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from naive.random_cameras import random_observations

from factorbus import idp
from factorbus.client.filter_state import augmented, factored
from factorbus.client.shared_memory_pool import SharedMemoryPool
from factorbus.idp import job, minimal
from factorbus.proto.features import Ask, Done, FeaturesAnswer, Observations, Shard, ShardDone
from factorbus.proto.features_codec import decode_answer, encode_answer, encode_ask, encode_shard
from factorbus.proto.problems import BadMessage
from factorbus.proto.segments import PAGE

N, CUTS = 150, ((0, 7), (7, 8), (8, 150))


@pytest.fixture(scope="module")
def seen() -> tuple[Observations, np.ndarray, np.ndarray]:
    """(observations, P before, P after)."""
    observations, P = random_observations(41, N, 2)
    return observations, P, minimal.covariance(P, observations, idp.see(observations)).P


def answered(ask: Ask, cuts: tuple[tuple[int, int], ...] = CUTS) -> FeaturesAnswer:
    """What workers would answer, over the wire's bytes."""
    data = encode_ask(ask)
    shards = [(job.do(encode_shard(Shard(data, *cut))), f"w{cut[0]}", 0.5) for cut in cuts]
    return decode_answer(encode_answer(shards, clean=True))


@pytest.mark.parametrize("form", ["rows", "half"])
def test_shards_become_the_grown_covariance(seen, form: str) -> None:
    observations, P, after = seen
    x = np.arange(float(observations.width))
    found = augmented(x, P, observations, answered(Ask(observations, form)), None)
    assert found.P.tobytes() == after.tobytes()
    assert found.x[: x.size].tobytes() == x.tobytes()
    assert found.x[x.size :].tobytes() == found.y.tobytes() == idp.see(observations).y.tobytes()
    assert (found.workers, found.seconds) == (("w0", "w7", "w8"), 0.5)


def test_rows_in_memory_and_rows_that_came_as_bytes_are_put_together(seen) -> None:
    """One worker shares memory with us, another does not."""
    observations, P, after = seen
    pool = SharedMemoryPool()
    m = observations.width
    allocation = pool.try_allocate(PAGE, after.shape, m)
    assert allocation is not None
    here = answered(Ask(observations, "rows", allocation.segment), CUTS[:2])
    elsewhere = answered(Ask(observations, "rows"), CUTS[2:])
    assert [done.shard.stored for done in here.shards] == [True, True]
    found = augmented(
        np.zeros(m), P, observations, FeaturesAnswer((*here.shards, *elsewhere.shards), True), allocation.matrix
    )
    assert found.P.tobytes() == after.tobytes()
    pool.settle(allocation, clean=False)
    pool.close()


def test_factors_give_every_block(seen) -> None:
    observations, _, after = seen
    found = factored(observations, answered(Ask(observations, "factored")))
    m = observations.width
    assert found.y.tobytes() == idp.see(observations).y.tobytes()
    scale = abs(after).max()
    for i, k in ((0, 0), (3, 140), (140, 3), (149, 149)):
        wanted = after[m + 6 * i : m + 6 * i + 6, m + 6 * k : m + 6 * k + 6]
        np.testing.assert_allclose(found.block(i, k), wanted, rtol=0, atol=1e-14 * scale)
        np.testing.assert_allclose(found.before(i), after[m + 6 * i : m + 6 * i + 6, :m], rtol=0, atol=1e-14 * scale)


def test_no_pixels_leave_everything_as_it_was(seen) -> None:
    observations, P, _ = seen
    none = Observations(observations.camera, observations.state, observations.covariance, np.empty((0, 2)))
    x = np.arange(float(observations.width))
    found = augmented(x, P, none, answered(Ask(none, "half"), ((0, 0),)), None)
    assert (found.x.tobytes(), found.P.tobytes(), found.y.shape) == (x.tobytes(), P.tobytes(), (0, 6))


def broken(change: Callable[[Done], Done | None]) -> Callable[[FeaturesAnswer], FeaturesAnswer]:
    """An answer with its middle shard changed, or left out."""

    def apply(answer: FeaturesAnswer) -> FeaturesAnswer:
        first, middle, last = answer.shards
        changed = change(middle)
        return answer._replace(shards=(first, changed, last) if changed else (first, last))

    return apply


def other(**fields: object) -> Callable[[Done], Done]:
    return lambda done: done._replace(shard=ShardDone(**{**done.shard._asdict(), **fields}))


@pytest.mark.parametrize(
    ("form", "change"),
    [
        ("rows", lambda _: None),
        ("rows", other(first=6)),
        ("rows", other(rows=None)),
        ("rows", other(rows=np.zeros((6, 3)))),
        ("rows", other(rows=None, stored=True)),
        ("half", other(cross=None)),
        ("half", other(blocks=np.zeros(35))),
    ],
)
def test_an_answer_that_cannot_be_is_no_covariance(seen, form: str, change: Callable[[Done], Done | None]) -> None:
    observations, P, _ = seen
    with pytest.raises(BadMessage):
        augmented(
            np.zeros(observations.width), P, observations, broken(change)(answered(Ask(observations, form))), None
        )


def descriptors() -> set[str]:
    """Of shared memory that this process holds."""
    links = {path: path.readlink() for path in Path("/proc/self/fd").iterdir() if path.is_symlink()}
    return {path.name for path, target in links.items() if "memfd:factorbus" in str(target)}


def test_memory_is_used_again_when_nobody_looks_at_it() -> None:
    before, pool = descriptors(), SharedMemoryPool()
    first = pool.try_allocate(PAGE, (300, 300), 10)
    assert first is not None
    descriptor, view = first.segment.descriptor, first.matrix[5:7]
    pool.settle(first, clean=True)
    del first
    gc.collect()
    second = pool.try_allocate(PAGE, (300, 300), 10)
    assert second is not None
    assert second.segment.descriptor != descriptor, "a view of the first is still looked at"
    view[:] = 1.0
    del view
    gc.collect()
    third = pool.try_allocate(PAGE, (290, 290), 10)
    assert third is not None
    assert third.segment.descriptor == descriptor
    assert third.segment.nonce != second.segment.nonce
    pool.settle(second, clean=False)
    pool.settle(third, clean=False)
    pool.close()
    del second, third
    gc.collect()
    assert descriptors() == before


def test_memory_that_somebody_may_still_write_to_is_not_used_again() -> None:
    before, pool = descriptors(), SharedMemoryPool()
    allocation = pool.try_allocate(PAGE, (300, 300), 0)
    assert allocation is not None
    pool.settle(allocation, clean=False)
    del allocation
    gc.collect()
    assert descriptors() == before
    again = pool.try_allocate(PAGE, (300, 300), 0)
    assert again is not None
    pool.settle(again, clean=True)
    pool.close()
    again.matrix[:] = 2.0  # lives on
    del again
    gc.collect()
    assert descriptors() == before


def test_there_is_no_memory_for_more_than_one_question_may_use() -> None:
    assert SharedMemoryPool().try_allocate(PAGE, (1 << 15, 1 << 15), 0) is None
