"""Features for filters over the bus: cut up, done by processes that may die or freeze, and every one arrives."""

import asyncio
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from bare import Bare, bare
from naive.random_cameras import random_observations
from processes import PATIENCE_S, Process

from factorbus import idp
from factorbus.client import aio, connect
from factorbus.idp import minimal
from factorbus.proto import keys
from factorbus.proto.features import Ask, FeaturesAnswer, Observations, Segment
from factorbus.proto.features_codec import decode_answer, encode_ask
from factorbus.proto.problems import BadShape, Refused, TooLarge, Unavailable
from factorbus.proto.segments import PAGE, Memory

Spawn = Callable[..., Process]
Question = tuple[Observations, np.ndarray, np.ndarray]
N = 200


@contextmanager
def service(spawn: Spawn, folder: Path, deadline_s: float = 60.0) -> Iterator[tuple[Process, str, Bare]]:
    settings = folder / "service.toml"
    settings.write_text(f'name = "s"\njob_deadline_s = {deadline_s}\nwarm = false\n')
    process = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings))
    (endpoint,) = process.ready()
    with bare(endpoint) as client:
        client.create("m")
        yield process, endpoint, client


def worker(spawn: Spawn, client: Bare, endpoint: str, name: str) -> Process:
    """A worker whose way has been measured."""
    started = spawn("-m", "factorbus.workers", "--connect", endpoint, "--name", name, "--no-warm")
    started.ready()
    measured(client, name)
    return started


def measured(client: Bare, name: str) -> None:
    """Until the service knows the way to a worker: its stats are answered while it measures, in turns."""
    rows = iter(lambda: client.stats("m")["workers"], None)
    assert next(row for table in rows for row in table if row["name"] == name and "latency_ms" in row)


def answer(client: Bare, ask: Ask) -> FeaturesAnswer:
    came = client.ask(keys.features_key("s"), encode_ask(ask))
    assert isinstance(came, bytes), came
    return decode_answer(came)


@pytest.fixture(scope="module")
def question() -> Question:
    """(observations, all its y, all its new rows)."""
    observations = random_observations(31, N, 3)[0]
    seen = idp.see(observations)
    rows = np.empty((6 * N, observations.width + 6 * N))
    minimal.FeatureRows(observations, seen).rows(0, N, rows)
    return observations, seen.y, rows


def put_together(got: FeaturesAnswer) -> bytes:
    """y of all features, which come once each and in order."""
    edges = [(done.shard.first, done.shard.last) for done in got.shards]
    assert [first for first, _ in edges] == [0, *(last for _, last in edges[:-1])]
    assert edges[-1][1] == N
    return np.concatenate([done.shard.y for done in got.shards]).tobytes()


@contextmanager
def into_memory(question: Question) -> Iterator[tuple[Ask, np.ndarray]]:
    """The question with shared memory for its rows: then little travels, and the way to a worker pays."""
    observations, _, rows = question
    with Memory(PAGE + rows.nbytes) as memory:
        yield Ask(observations, "rows", memory.segment(PAGE)), memory.array(PAGE, rows.shape)


def test_every_process_computes_the_same_bits(spawn: Spawn, tmp_path: Path, question: Question) -> None:
    observations, y, rows = question
    with service(spawn, tmp_path) as (process, endpoint, client):
        workers: list[Process] = []
        for new, names in (("", {"in-place"}), ("a", {"a"}), ("b", {"a", "b"})):
            workers += [worker(spawn, client, endpoint, new)] if new else []
            got = answer(client, Ask(observations))
            assert put_together(got) == y.tobytes()
            assert np.concatenate([done.shard.rows for done in got.shards]).tobytes() == rows.tobytes()
            with into_memory(question) as (ask, array):
                stored = answer(client, ask)
                assert {done.worker for done in stored.shards} == names
                assert (put_together(stored), stored.clean) == (y.tobytes(), True)
                assert array.tobytes() == rows.tobytes()
        few = Observations(observations.camera, observations.state, observations.covariance, observations.pixels[:2])
        assert [done.worker for done in answer(client, Ask(few)).shards] == ["in-place"], "too little for the way"
        for each in (process, *workers):
            each.signal(signal.SIGTERM)
            assert each.wait() == 0


def test_while_all_are_busy_a_question_stays_whole(spawn: Spawn, tmp_path: Path, question: Question) -> None:
    _, y, rows = question
    with service(spawn, tmp_path) as (_, endpoint, client), into_memory(question) as one, into_memory(question) as two:
        workers = [worker(spawn, client, endpoint, name) for name in ("a", "b")]
        for each in workers:
            each.signal(signal.SIGSTOP)
        waiting = [client.send(keys.features_key("s"), encode_ask(ask)) for ask, _ in (one, two)]
        in_flight = iter(lambda: sum(row["in_flight"] for row in client.stats("m")["workers"]), None)
        assert next(count for count in in_flight if count >= 3) == 3
        for each in workers:
            each.signal(signal.SIGCONT)
        got = [decode_answer(came) for came in (each.get(timeout=PATIENCE_S) for each in waiting)]
        assert [len(each.shards) for each in got] == [2, 1]
        for each, (_, array) in zip(got, (one, two), strict=True):
            assert put_together(each) == y.tobytes()
            assert array.tobytes() == rows.tobytes()


def test_a_question_that_cannot_be_is_refused_with_its_code(spawn: Spawn, tmp_path: Path, question: Question) -> None:
    observations, *_ = question
    with service(spawn, tmp_path) as (_, endpoint, client):
        for helped in (False, True):
            if helped:
                worker(spawn, client, endpoint, "a")
            pixels = observations.pixels.copy()
            pixels[150] = [-10.0, 3.0]
            bad = Observations(observations.camera, observations.state, observations.covariance, pixels)
            came = client.ask(keys.features_key("s"), encode_ask(Ask(bad)))
            assert isinstance(came, Refused)
            assert (came.code, came.detail["index"]) == ("bad_pixel", 150)
            came = client.ask(keys.features_key("s"), b"\xc1")
            assert isinstance(came, Refused)
            assert came.code == "bad_message"


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP])
def test_a_worker_that_dies_or_freezes_costs_a_retry_and_no_feature(
    spawn: Spawn, tmp_path: Path, question: Question, how: signal.Signals
) -> None:
    _, y, rows = question
    with service(spawn, tmp_path, deadline_s=0.5) as (_, endpoint, client), into_memory(question) as (ask, array):
        first, _ = (worker(spawn, client, endpoint, name) for name in ("a", "b"))
        first.signal(signal.SIGSTOP)  # the shard is with a worker that does not answer
        waiting = client.send(keys.features_key("s"), encode_ask(ask))
        in_flight = iter(lambda: client.stats("m")["workers"], None)
        assert next(row for table in in_flight for row in table if row["name"] == "a" and row["in_flight"])
        if how == signal.SIGKILL:
            first.signal(signal.SIGKILL)
        came = waiting.get(timeout=PATIENCE_S)
        assert isinstance(came, bytes), came
        got = decode_answer(came)
        assert put_together(got) == y.tobytes()
        assert array.tobytes() == rows.tobytes()
        assert "a" not in {done.worker for done in got.shards}
        assert not got.clean, "somebody was given up"
        if how == signal.SIGSTOP:
            assert answer(client, ask).clean, "a suspect is given nothing"
            first.signal(signal.SIGCONT)
            seen = iter(lambda: {done.worker for done in answer(client, ask).shards}, None)
            assert next(names for names in seen if "a" in names), "it is heard of again"


def test_a_front_end_on_another_host_gets_the_same_without_shared_memory(
    spawn: Spawn, tmp_path: Path, question: Question, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the service a file that has another nonce is a file on another host."""
    observations = question[0]
    P = random_observations(31, N, 3)[1]
    x = np.concatenate([observations.state, np.zeros(observations.width - 13)])
    after = minimal.covariance(P, observations, idp.see(observations)).P.tobytes()
    large = random_observations(32, 1070)[0]  # 330 MB as rows, 165 as the upper half
    prior = {name: getattr(observations, name) for name in ("rho", "sigma_rho", "sigma_pixel")}
    with service(spawn, tmp_path) as (_, endpoint, _), connect(endpoint, client="camera", timeout_s=60) as bus:
        with bus.features(observations.camera, **prior) as front:
            assert front.grow(x, P, observations.pixels).P.tobytes() == after
            assert front.shares_memory
            monkeypatch.setattr(Memory, "segment", segment_elsewhere)
            assert front.grow(x, P, observations.pixels).P.tobytes() == after
            assert not front.shares_memory, "so the upper half is sent from now on"
            assert front.grow(x, P, observations.pixels).P.tobytes() == after
        with bus.features(large.camera, **prior) as front:
            grown = front.grow(large.state, large.covariance, large.pixels)
            assert grown.P.shape == (13 + 6 * 1070,) * 2
            assert np.array_equal(grown.P[-60:], grown.P[:, -60:].T)
            with pytest.raises(TooLarge):
                front.grow(large.state, large.covariance, np.tile(large.pixels, (2, 1)))


TRUE_SEGMENT = Memory.segment


def segment_elsewhere(memory: Memory, offset: int) -> Segment:
    return TRUE_SEGMENT(memory, offset)._replace(nonce="0" * 32)


def test_a_filter_gets_factors_and_its_problems_by_name(spawn: Spawn, tmp_path: Path, question: Question) -> None:
    observations, y, rows = question
    x = np.concatenate([observations.state, np.zeros(observations.width - 13)])
    prior = {name: getattr(observations, name) for name in ("rho", "sigma_rho", "sigma_pixel")}
    with (
        service(spawn, tmp_path) as (_, endpoint, _),
        connect(endpoint, client="camera", timeout_s=60) as bus,
        bus.features(observations.camera, service="s", **prior) as front,
    ):
        parts = front.factor(x, observations.covariance, observations.pixels)
        assert parts.y.tobytes() == y.tobytes()
        m = observations.width
        np.testing.assert_allclose(parts.block(3, 170), rows[18:24, m + 6 * 170 :][:, :6], atol=1e-13)
        with pytest.raises(Refused) as refused:
            front.factor(x, observations.covariance, np.array([[np.inf, 0.0]]))
        assert refused.value.code == "bad_pixel"

        async def on_a_loop() -> tuple[bytes, bytes]:
            async with (
                aio.connect(endpoint, client="loop") as loop,
                loop.features(observations.camera, **prior) as slow,
            ):
                parts = await slow.factor(x, observations.covariance, observations.pixels)
                return parts.y.tobytes(), (await slow.grow(x[:13], np.eye(13), observations.pixels)).y.tobytes()

        assert asyncio.run(on_a_loop()) == (y.tobytes(), y.tobytes())
        for wrong in (x[:12], x[None]):
            with pytest.raises(BadShape):
                front.grow(wrong, np.eye(13), observations.pixels)
        with pytest.raises(Unavailable):
            bus.features(observations.camera, service="another").factor(
                x, observations.covariance, observations.pixels, timeout_s=0.2
            )
