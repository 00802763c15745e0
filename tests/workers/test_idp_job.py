"""The job of kind `idp`: in any shards and by any way of answering the same bits; shared memory that cannot harm."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from naive.random_sightings import random_sighting

from factorbus import idp
from factorbus.idp import job, minimal
from factorbus.proto import segments
from factorbus.proto.features import Ask, Segment, Shard, ShardDone, Sighting, rows_size
from factorbus.proto.features_codec import decode_shard_done, encode_ask, encode_shard
from factorbus.proto.problems import BadMessage, Problem, TooLarge
from factorbus.proto.segments import PAGE, Memory
from factorbus.workers import jobs

N, M = 12, 25


@pytest.fixture
def sighting() -> Sighting:
    return random_sighting(21, N, 2)[0]


def done(ask: Ask, first: int = 0, last: int = N) -> ShardDone:
    return decode_shard_done(jobs.do("idp", encode_shard(Shard(encode_ask(ask), first, last))))


def whole(sighting: Sighting) -> np.ndarray:
    """All new rows."""
    rows = np.empty((6 * N, M + 6 * N))
    minimal.Parts(sighting, idp.see(sighting)).rows(0, N, rows)
    return rows


def test_shards_put_together_are_the_whole_in_every_form(sighting: Sighting) -> None:
    rows = whole(sighting)
    parts = [done(Ask(sighting, "rows"), *cut) for cut in ((0, 5), (5, 6), (6, 12))]
    assert np.concatenate([part.rows for part in parts]).tobytes() == rows.tobytes()  # type: ignore[arg-type]
    assert np.concatenate([part.y for part in parts]).tobytes() == idp.see(sighting).y.tobytes()
    half = done(Ask(sighting, "half"), 3, 12)
    assert half.cross is not None
    assert half.blocks is not None
    assert half.cross.tobytes() == np.ascontiguousarray(rows[18:, :M]).tobytes()
    assert half.blocks[: 36 * 9].tobytes() == np.ascontiguousarray(rows[18:24, M + 18 :]).tobytes()
    factored = done(Ask(sighting, "factored"), 2, 4)
    assert factored.turn is not None
    assert factored.turn.tobytes() == idp.see(sighting).turn[2:4].tobytes()


def test_a_shard_in_shared_memory_is_the_same_and_the_name_goes(sighting: Sighting) -> None:
    with Memory(PAGE + rows_size(N, M)) as memory:
        array = memory.array(PAGE, (6 * N, M + 6 * N))
        ask = Ask(sighting, "rows", memory.segment(PAGE))
        for cut in ((0, 5), (5, 12)):
            answer = done(ask, *cut)
            assert answer.stored
            assert answer.rows is None
        path = segments.FOLDER / memory.segment(PAGE).name
        assert path.stat().st_mode & 0o777 == 0o600
    assert not path.exists()
    assert array.tobytes() == whole(sighting).tobytes(), "the array outlives the name"
    assert done(ask).rows is not None, "who comes too late answers with bytes"


def test_a_large_answer_is_written_in_pieces() -> None:
    n = 300
    large = random_sighting(22, n)[0]
    with Memory(PAGE + rows_size(n, 13)) as memory:
        array = memory.array(PAGE, (6 * n, 13 + 6 * n))
        assert done(Ask(large, "rows", memory.segment(PAGE)), 0, n).stored
    expected = np.empty_like(array)
    minimal.Parts(large, idp.see(large)).rows(0, n, expected)
    assert array.tobytes() == expected.tobytes()


def test_memory_that_is_not_what_it_says_is_not_written_to(sighting: Sighting, tmp_path: Path) -> None:
    size = PAGE + rows_size(N, M)
    victim = tmp_path / "victim"
    victim.write_bytes(bytes(size))
    with Memory(size) as memory:
        good = memory.segment(PAGE)
        link = segments.FOLDER / f"factorbus-{os.getpid()}-{'a' * 32}"
        link.symlink_to(victim)
        try:
            for bad in (
                good._replace(nonce="0" * 32),
                good._replace(name="factorbus-1-" + "0" * 32),
                good._replace(name="../../" + str(victim)),
                good._replace(name=link.name, nonce="\0" * 32),
                good._replace(offset=0),
                good._replace(offset=PAGE + 4),
                good._replace(offset=PAGE + 8),
                good._replace(size=size + PAGE),
            ):
                answer = done(Ask(sighting, "rows", Segment(*bad)))
                assert not answer.stored, bad
                assert answer.rows is not None
        finally:
            link.unlink()
        assert not memory.array(PAGE, (6 * N, M + 6 * N)).any()
    assert not any(victim.read_bytes())


def test_memory_that_is_cut_short_ends_nobody(sighting: Sighting) -> None:
    """A mapping would be a SIGBUS; here it is not the file that was announced, and the rows come as bytes."""
    with Memory(PAGE + rows_size(N, M)) as memory:
        segment = memory.segment(PAGE)
        os.truncate(segments.FOLDER / segment.name, PAGE)
        assert done(Ask(sighting, "rows", segment)).rows is not None


def test_a_full_shared_memory_ends_in_bytes(sighting: Sighting, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with Memory(PAGE + rows_size(N, M)) as memory:
        monkeypatch.setattr(segments.os, "pwrite", full)
        assert done(Ask(sighting, "rows", memory.segment(PAGE))).rows is not None


def test_what_a_killed_asker_left_is_removed_when_it_is_old() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as gone:
        gone.wait()
    left = segments.FOLDER / f"factorbus-{gone.pid}-{'b' * 32}"
    ours = segments.FOLDER / f"factorbus-{os.getpid()}-{'b' * 32}"
    try:
        for path in (left, ours):
            path.write_bytes(b"")
        Memory(PAGE).close()
        assert left.exists(), "somebody in another container may be using it"
        for path in (left, ours):
            os.utime(path, (1, 1))
        Memory(PAGE).close()
        assert (left.exists(), ours.exists()) == (False, True)
    finally:
        left.unlink(missing_ok=True)
        ours.unlink(missing_ok=True)


def test_there_must_be_room() -> None:
    with pytest.raises(OSError, match="no room"):
        Memory(1 << 60)


def test_what_cannot_be_done_has_a_code(sighting: Sighting) -> None:
    ask = encode_ask(Ask(sighting))
    with pytest.raises(BadMessage):
        job.do(encode_shard(Shard(ask, 0, N + 1)))
    with pytest.raises(BadMessage):
        job.do(encode_shard(Shard(b"\xc1", 0, 1)))
    with pytest.raises(TooLarge):
        job.do(encode_shard(Shard(encode_ask(Ask(random_sighting(1, 1100)[0])), 0, 1)))
    bad = Sighting(sighting.camera, sighting.state, sighting.covariance, np.array([[-9.0, 0.0]]))
    with pytest.raises(Problem) as refused:
        job.do(encode_shard(Shard(encode_ask(Ask(bad)), 0, 1)))
    assert refused.value.code == "bad_pixel"
