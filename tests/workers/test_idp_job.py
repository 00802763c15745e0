"""The job of kind `idp`: in any shards and by any way of answering the same bits; shared memory that cannot harm."""

import os
from pathlib import Path

import numpy as np
import pytest
from naive.random_cameras import random_observations

from factorbus import idp
from factorbus.idp import job, minimal
from factorbus.proto import segments
from factorbus.proto.features import Ask, Observations, Segment, Shard, ShardDone, new_rows_size
from factorbus.proto.features_codec import decode_shard_done, encode_ask, encode_shard
from factorbus.proto.problems import BadMessage, Problem, TooLarge
from factorbus.proto.segments import PAGE, Memory
from factorbus.workers import jobs

N, M = 12, 25


@pytest.fixture
def observations() -> Observations:
    return random_observations(21, N, 2)[0]


def done(ask: Ask, first: int = 0, last: int = N) -> ShardDone:
    return decode_shard_done(jobs.run_job("idp", encode_shard(Shard(encode_ask(ask), first, last))))


def whole(observations: Observations) -> np.ndarray:
    """All new rows."""
    rows = np.empty((6 * N, M + 6 * N))
    minimal.FeatureRows(observations, idp.see(observations)).rows(0, N, rows)
    return rows


def test_shards_put_together_are_the_whole_in_every_form(observations: Observations) -> None:
    rows = whole(observations)
    parts = [done(Ask(observations, "rows"), *cut) for cut in ((0, 5), (5, 6), (6, 12))]
    assert np.concatenate([part.rows for part in parts]).tobytes() == rows.tobytes()  # type: ignore[arg-type]
    assert np.concatenate([part.y for part in parts]).tobytes() == idp.see(observations).y.tobytes()
    half = done(Ask(observations, "half"), 3, 12)
    assert half.cross is not None
    assert half.blocks is not None
    assert half.cross.tobytes() == np.ascontiguousarray(rows[18:, :M]).tobytes()
    assert half.blocks[: 36 * 9].tobytes() == np.ascontiguousarray(rows[18:24, M + 18 :]).tobytes()
    factored = done(Ask(observations, "factored"), 2, 4)
    assert factored.turn is not None
    assert factored.turn.tobytes() == idp.see(observations).turn[2:4].tobytes()


def test_a_shard_in_shared_memory_is_the_same_and_the_memory_goes(observations: Observations) -> None:
    with Memory(PAGE + new_rows_size(N, M)) as memory:
        array = memory.array(PAGE, (6 * N, M + 6 * N))
        ask = Ask(observations, "rows", memory.segment(PAGE))
        for cut in ((0, 5), (5, 12)):
            answer = done(ask, *cut)
            assert answer.stored
            assert answer.rows is None
        assert done(ask, 4, 4).y.shape == (0, 6)
    assert array.tobytes() == whole(observations).tobytes(), "the array outlives the file"
    assert done(ask).rows is not None, "who comes too late answers with bytes"


def test_rows_go_where_the_asker_wants_them() -> None:
    """Anywhere in the file, pages or not."""
    n = 70
    large = random_observations(22, n)[0]
    expected = np.empty((6 * n, 13 + 6 * n))
    minimal.FeatureRows(large, idp.see(large)).rows(0, n, expected)
    for offset in (PAGE, PAGE + 8, 3 * PAGE - 8):
        with Memory(offset + new_rows_size(n, 13)) as memory:
            array = memory.array(offset, expected.shape)
            ask = Ask(large, "rows", memory.segment(offset))
            for cut in ((0, 1), (1, 64), (64, n)):
                assert done(ask, *cut).stored
            assert array.tobytes() == expected.tobytes()


def test_a_file_that_is_not_what_it_says_is_not_written_to(observations: Observations, tmp_path: Path) -> None:
    size = PAGE + new_rows_size(N, M)
    content = ("0" * 32).encode() + bytes(size - 32)
    (tmp_path / "victim").write_bytes(content)
    with Memory(size) as memory, (tmp_path / "victim").open("r+b") as victim:
        good = memory.segment(PAGE)
        for bad in (
            good._replace(nonce="0" * 32),
            good._replace(process=2**22 + 1),
            good._replace(process=2**62),
            good._replace(descriptor=9999),
            good._replace(descriptor=victim.fileno(), nonce="0" * 32),
            good._replace(descriptor=0),
            good._replace(offset=0),
            good._replace(offset=PAGE + 4),
            good._replace(offset=PAGE + 8),
            good._replace(offset=2**62),
            good._replace(size=size + PAGE),
        ):
            answer = done(Ask(observations, "rows", Segment(*bad)))
            assert not answer.stored, bad
            assert answer.rows is not None
        assert not memory.array(PAGE, (6 * N, M + 6 * N)).any()
    assert (tmp_path / "victim").read_bytes() == content


def test_a_file_that_could_be_cut_short_is_not_mapped(observations: Observations) -> None:
    """Writing to a mapping beyond its file's end would end the worker."""
    size = PAGE + new_rows_size(N, M)
    descriptor = os.memfd_create("not sealed", os.MFD_ALLOW_SEALING)
    try:
        os.truncate(descriptor, size)
        os.pwrite(descriptor, b"0" * 32, 0)
        segment = Segment(os.getpid(), descriptor, "0" * 32, size, PAGE)
        assert done(Ask(observations, "rows", segment)).rows is not None
    finally:
        os.close(descriptor)
    with Memory(size) as memory, pytest.raises(PermissionError):
        os.truncate(memory.segment(PAGE).descriptor, PAGE)


def test_there_is_an_end_to_what_one_question_may_use() -> None:
    with pytest.raises(OSError, match="more than"):
        Memory(segments.MOST_BYTES + 1)


def test_what_cannot_be_done_has_a_code(observations: Observations) -> None:
    ask = encode_ask(Ask(observations))
    with pytest.raises(BadMessage):
        job.do(encode_shard(Shard(ask, 0, N + 1)))
    with pytest.raises(BadMessage):
        job.do(encode_shard(Shard(b"\xc1", 0, 1)))
    with pytest.raises(TooLarge):
        job.do(encode_shard(Shard(encode_ask(Ask(random_observations(1, 1100)[0])), 0, 1)))
    bad = Observations(observations.camera, observations.state, observations.covariance, np.array([[-9.0, 0.0]]))
    with pytest.raises(Problem) as refused:
        job.do(encode_shard(Shard(encode_ask(Ask(bad)), 0, 1)))
    assert refused.value.code == "bad_pixel"
