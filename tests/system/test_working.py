"""Workers as processes: they take batch optima, and when they die others do."""

import queue
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest
from bare import PATIENCE_S, Bare, bare, edge, pose, start
from processes import Process
from zenoh.handlers import Callback

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Chi2, Insert
from factorbus.solver import Options

Spawn = Callable[..., Process]
QUESTION = codec.encode_map({"batch": True, "timeout_s": 60})


@contextmanager
def service(spawn: Spawn, *arguments: str) -> Iterator[tuple[Process, str, Bare]]:
    process = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", *arguments)
    (endpoint,) = process.ready()
    with bare(endpoint) as client:
        fill(client)
        yield process, endpoint, client


def fill(client: Bare) -> None:
    """A map m with three poses that do not quite agree."""
    client.create("m")
    loop = Batch(factors=(edge("x0", "x2", 2.3),))
    for sequence, batch in enumerate((start(), pose("x1", "x0"), pose("x2", "x1"), loop), 1):
        insert = codec.encode_insert(Insert(sequence, batch, settle=batch is loop))
        assert isinstance(client.ask(keys.insert_key("m", "a"), insert), bytes)


def worker(spawn: Spawn, endpoint: str, name: str) -> Process:
    started = spawn("-m", "factorbus.workers", "--connect", endpoint, "--name", name)
    started.ready()
    return started


def optimum(client: Bare) -> Chi2:
    answer = client.ask(keys.ask_key("m", "chi2"), QUESTION)
    assert isinstance(answer, bytes), answer
    return codec.decode_chi2(answer)


def test_jobs_go_to_workers_and_on_when_one_dies(spawn: Spawn) -> None:
    with service(spawn) as (_, endpoint, client):
        alone = optimum(client)
        assert alone.worker == "in-place"
        assert alone.batch == pytest.approx(alone.chi2, rel=1e-6)

        first, second = worker(spawn, endpoint, "a"), worker(spawn, endpoint, "b")
        helped = optimum(client)
        assert (helped.worker, helped.batch) == ("a", alone.batch), "the same bits wherever it is done"

        first.signal(signal.SIGSTOP)  # the job is with a worker that does not answer
        waiting = client.send(keys.ask_key("m", "chi2"), QUESTION)
        in_flight = next(w for w in iter(lambda: client.stats("m")["workers"], None) if w and w[0]["in_flight"])
        assert [row["name"] for row in in_flight] == ["a", "b"]
        first.signal(signal.SIGKILL)
        answer = waiting.get(timeout=PATIENCE_S)
        assert isinstance(answer, bytes), answer
        assert codec.decode_chi2(answer).worker == "b"

        second.signal(signal.SIGTERM)
        assert second.wait() == 0
        assert optimum(client).worker == "in-place"


def test_a_worker_that_does_not_answer_in_time_loses_the_job(spawn: Spawn, tmp_path) -> None:
    settings = tmp_path / "service.toml"
    settings.write_text("job_deadline_s = 0.5\n")
    with service(spawn, "--config", str(settings)) as (_, endpoint, client):
        stuck = worker(spawn, endpoint, "a")
        stuck.signal(signal.SIGSTOP)
        assert optimum(client).worker == "in-place"
        stuck.signal(signal.SIGCONT)


def test_a_worker_outlives_its_service(spawn: Spawn) -> None:
    with service(spawn) as (first, endpoint, _):
        helper = worker(spawn, endpoint, "w")
        first.signal(signal.SIGKILL)
        first.wait()
    spawn("-m", "factorbus.service", "--listen", endpoint).ready()
    with bare(endpoint) as client:
        fill(client)
        wait_for(client, keys.worker_token("w", 1))
        assert optimum(client).worker == "w"
        helper.signal(signal.SIGTERM)
        assert helper.wait() == 0


def test_a_worker_may_come_before_its_service_and_leave_before_it(spawn: Spawn) -> None:
    early = spawn("-m", "factorbus.workers", "--connect", "tcp/127.0.0.1:1", "--no-warm")
    early.said("nothing at tcp/127.0.0.1:1 yet")
    early.signal(signal.SIGINT)
    assert early.wait() == 0


def test_stats_name_the_thresholds_in_force(spawn: Spawn) -> None:
    with service(spawn) as (_, _, client):
        told = client.stats("m")
        assert told["options"] == Options(mode=told["mode"]).as_dict()
        assert told["options"]["small_loop_threshold"] > 0
        assert "clock" not in told["options"]


def wait_for(client: Bare, token: str) -> None:
    """Until `token` is alive."""
    seen: queue.SimpleQueue[str] = queue.SimpleQueue()
    subscriber = client.session.liveliness().declare_subscriber(
        token, Callback(lambda sample: seen.put(str(sample.key_expr)), indirect=False), history=True
    )
    seen.get(timeout=PATIENCE_S)
    subscriber.undeclare()
