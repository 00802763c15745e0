"""Workers that answer wrongly, each in its way: nothing of it reaches who asked, and they get no more jobs."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from bare import Bare, bare, edge, pose, start
from naive.random_cameras import random_observations
from processes import Process, processes

from factorbus import idp
from factorbus.idp import minimal
from factorbus.proto import codec, keys
from factorbus.proto.features import Ask, Observations
from factorbus.proto.features_codec import decode_answer, encode_ask
from factorbus.proto.messages import Batch, Chi2, Insert
from factorbus.proto.segments import PAGE, Memory

FAULTY = str(Path(__file__).parents[1] / "faulty" / "worker.py")
N = 200
BOTH = ["refuses", "unreadable", "unreadable_payload", "unreadable_problem", "other_job", "other_kind", "seconds"]


@dataclass
class Bench:
    """A service, and a process that has workers."""

    client: Bare
    endpoint: str
    service: Process
    workers: Process

    def worker(self, fault: str) -> str:
        """A worker with `fault`, once the service knows the way to it."""
        name = f"w_{fault}"
        self.workers.tell(f"{name} {fault}")
        self.workers.line(f"born {name}")
        next(True for row in self.rows(name) if "latency_ms" in row or row["distrusted"] or fault == "only_batch")
        return name

    def rows(self, name: str) -> Iterator[dict]:
        """What stats say of a worker, again and again, as long as it is there."""
        while True:
            yield from (row for row in self.client.stats("m")["workers"] if row["name"] == name)

    def optimum(self) -> Chi2:
        question = codec.encode_map({"batch": True, "timeout_s": 60})
        came = self.client.ask(keys.ask_key("m", "chi2"), question)
        assert isinstance(came, bytes), came
        return codec.decode_chi2(came)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    folder = tmp_path_factory.mktemp("bench")
    (folder / "service.toml").write_text('name = "s"\nwarm = false\n')
    with ExitStack() as stack:
        spawn: Callable[..., Process] = stack.enter_context(processes(folder))
        settings = str(folder / "service.toml")
        service = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", settings)
        (endpoint,) = service.ready()
        workers = spawn(FAULTY, endpoint)
        workers.ready()
        client = stack.enter_context(bare(endpoint))
        client.create("m")
        batches = (start(), pose("x1", "x0"), pose("x2", "x1"), Batch(factors=(edge("x0", "x2", 2.3),)))
        for sequence, batch in enumerate(batches, 1):
            insert = codec.encode_insert(Insert(sequence, batch, settle=sequence == 4))
            assert isinstance(client.ask(keys.insert_key("m", "a"), insert), bytes)
        yield Bench(client, endpoint, service, workers)


@pytest.mark.parametrize(
    "fault",
    [
        *BOTH, "refuses_the_graph", "chi2_negative", "chi2_nan", "chi2_other", "start_unknown", "values_moved",
        "values_nan", "one_missing", "other_keys", "one_twice", "other_kind_of_variable", "converged_no_bool",
    ],
)  # fmt: skip
def test_a_wrong_optimum_is_found_anew(bench: Bench, fault: str) -> None:
    name = bench.worker(fault)
    found = bench.optimum()
    assert found.worker == "in-place"
    assert found.batch == pytest.approx(found.chi2, rel=1e-6)
    assert next(row for row in bench.rows(name) if row["distrusted"])["wrong"] == 1
    assert bench.optimum().worker == "in-place", "it gets nothing for a while"
    assert next(bench.rows(name))["wrong"] == 1


def test_one_that_answers_well_is_believed(bench: Bench) -> None:
    name = bench.worker("none")
    found = bench.optimum()
    assert found.worker == name
    assert found.batch == pytest.approx(found.chi2, rel=1e-6)
    assert next(bench.rows(name))["wrong"] == 0


def test_one_that_ended_before_it_had_converged_is_believed_and_that_is_told(bench: Bench) -> None:
    name = bench.worker("early")
    found = bench.optimum()
    assert (found.worker, found.batch_converged, found.notice) == (name, False, None)
    assert next(bench.rows(name))["wrong"] == 0
    command = [sys.executable, "-m", "factorbus.cli", "change", "adopt", "m", "--connect", bench.endpoint]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    told = " ".join(ran.stdout.split())
    assert "not converged, the true optimum may be lower" in told
    assert "nothing: the map is not more than 1 % above that" in told


@pytest.fixture(scope="module")
def question() -> tuple[Observations, bytes, np.ndarray]:
    """(observations, its y, its new rows)."""
    observations = random_observations(31, N, 3)[0]
    seen = idp.see(observations)
    rows = np.empty((6 * N, observations.width + 6 * N))
    minimal.FeatureRows(observations, seen).rows(0, N, rows)
    return observations, seen.y.tobytes(), rows


@pytest.mark.parametrize("fault", [*BOTH, "y_nan", "y_elsewhere", "shard_of_another", "rows_short", "neither"])
def test_wrong_features_are_made_anew(
    bench: Bench, question: tuple[Observations, bytes, np.ndarray], fault: str
) -> None:
    observations, y, rows = question
    name = bench.worker(fault)
    with Memory(PAGE + rows.nbytes) as memory:
        came = bench.client.ask(keys.features_key("s"), encode_ask(Ask(observations, "rows", memory.segment(PAGE))))
        assert isinstance(came, bytes), came
        got = decode_answer(came)
        assert {done.worker for done in got.shards} == {"in-place"}
        assert b"".join(done.shard.y.tobytes() for done in got.shards) == y
        assert memory.array(PAGE, rows.shape).tobytes() == rows.tobytes()
        assert not got.clean, "somebody else has been at it"
    assert next(row for row in bench.rows(name) if row["distrusted"])["wrong"] >= 1


def test_one_whose_probes_are_wrong_gets_no_job(bench: Bench) -> None:
    name = bench.worker("probe")
    assert next(bench.rows(name)) == {"name": name, "slots": 2, "in_flight": 0, "wrong": 1, "distrusted": True}
    assert bench.optimum().worker == "in-place"


def test_one_that_does_only_batch_gets_only_batch(
    bench: Bench, question: tuple[Observations, bytes, np.ndarray]
) -> None:
    observations, y, rows = question
    name = bench.worker("only_batch")
    assert bench.optimum().worker == name
    with Memory(PAGE + rows.nbytes) as memory:
        came = bench.client.ask(keys.features_key("s"), encode_ask(Ask(observations, "rows", memory.segment(PAGE))))
        assert isinstance(came, bytes), came
        got = decode_answer(came)
    assert ([done.worker for done in got.shards], got.clean) == (["in-place"], True), "it was not asked"
    assert b"".join(done.shard.y.tobytes() for done in got.shards) == y
    assert next(bench.rows(name))["wrong"] == 0


def test_operators_are_told(bench: Bench) -> None:
    name = bench.worker("chi2_negative")
    before, lines = stats(bench)["wrong_answers"], warnings(bench, name)
    bench.optimum()
    assert stats(bench)["wrong_answers"] == before + 1
    (line,) = warnings(bench, name)[len(lines) :]
    assert "answered a batch job with χ² -1, where its values have" in line


def warnings(bench: Bench, name: str) -> list[str]:
    """What the service's log warns of a worker."""
    return [line for line in bench.service.errors().splitlines() if "WARNING" in line and f"worker {name} " in line]


def stats(bench: Bench) -> dict:
    came = bench.client.ask(keys.admin_key("stats"))
    assert isinstance(came, bytes)
    return codec.decode_map(came)
