"""Alive means alive: what systemd, an orchestrator, Prometheus and clients are told while a solver hangs, and after."""

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bare import bare
from processes import PATIENCE_S, Process
from prometheus_client.parser import text_string_to_metric_families

from factorbus.client import Draft, connect
from factorbus.proto import keys

Spawn = Callable[..., Process]
STUCK_SERVICE = str(Path(__file__).parent.parent / "faulty" / "stuck.py")

STUCK_S = 3.0  # longer than a thread that is well waits for a core


class Manager:
    """The service manager's end of NOTIFY_SOCKET.

    It reads while a test does other things, as a real one does: who sends waits while the socket is full.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._came: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def hear(self, wanted: str) -> str:
        """The next message with `wanted` in it."""
        while wanted not in (said := self._came.get(timeout=PATIENCE_S)):
            pass
        return said

    def silent_of(self, word: str, seconds: float) -> bool:
        """Is `word` not said for so long?  What was said before does not count."""
        while not self._came.empty():
            self._came.get()
        end = time.monotonic() + seconds
        with contextlib.suppress(queue.Empty):
            while (left := end - time.monotonic()) > 0:
                if word in self._came.get(timeout=left):
                    return False
        return True

    def close(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", str(self.path))
        self._reader.join(PATIENCE_S)
        self._socket.close()

    def _read(self) -> None:
        while said := self._socket.recv(4096):
            self._came.put(said.decode())


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Manager]:
    made = Manager(tmp_path / "notify")
    monkeypatch.setenv("NOTIFY_SOCKET", str(made.path))
    monkeypatch.setenv("WATCHDOG_USEC", "1200000")
    monkeypatch.delenv("WATCHDOG_PID", raising=False)
    yield made
    made.close()


class Port:
    """The metrics port."""

    def __init__(self) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.where = f"127.0.0.1:{probe.getsockname()[1]}"

    def get(self, path: str) -> tuple[int, str]:
        """(status, text)"""
        try:
            with urllib.request.urlopen(f"http://{self.where}/{path}", timeout=PATIENCE_S) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()

    def until(self, path: str, status: int) -> str:
        """The text, once the status is so."""
        end = time.monotonic() + PATIENCE_S
        while (got := self.get(path))[0] != status:
            assert time.monotonic() < end, got
            time.sleep(0.05)  # a status tells nobody that it has changed
        return got[1]

    def metrics(self, wanted: tuple[str, ...] | None = None) -> dict[tuple[str, ...], float]:
        """Samples by name and values of labels, in their order; once `wanted` is one of them."""
        end = time.monotonic() + PATIENCE_S
        while True:
            samples = {
                (sample.name, *sorted(sample.labels.values())): sample.value
                for family in text_string_to_metric_families(self.get("metrics")[1])
                for sample in family.samples
            }
            if wanted is None or wanted in samples:
                return samples
            assert time.monotonic() < end, sorted(samples)
            time.sleep(0.05)


def point(name: str) -> Draft:
    return Draft().point2(name, (1, 2)).prior_point2(name, (1, 2), sigmas=(0.1, 0.1))


@pytest.mark.parametrize("thread", ["solver's", "receiving"])
def test_a_stuck_solver_is_not_alive_and_comes_back(
    tmp_path: Path, spawn: Spawn, manager: Manager, thread: str
) -> None:
    settings, stuck, port = tmp_path / "serve.toml", tmp_path / "stuck", Port()
    settings.write_text(f'stuck_s = {STUCK_S}\nmetrics = "{port.where}"\n')
    options = ("--listen", "tcp/127.0.0.1:0", "--config", str(settings), "--map", "hall", "--map", "kitchen")
    service = spawn(STUCK_SERVICE, str(stuck), "serve", *options)
    endpoint = service.ready()[0]
    assert endpoint in manager.hear("READY=1")
    with (
        connect(endpoint, timeout_s=60) as bus,
        bus.map("kitchen", mirror=False) as kitchen,
        # Of somebody else: what a client sends behind a step that is made where it is received waits for that step.
        connect(endpoint, timeout_s=60) as another,
        another.map("hall") as hall,
    ):
        if thread == "receiving":  # short steps are made on the thread that receives
            for n in range(5):
                kitchen.insert(point(f"l{n}"))
                time.sleep(0.01)
        manager.hear("WATCHDOG=1")
        assert (port.get("live"), port.get("ready")) == ((200, "ok\n"), (200, "ok\n"))
        stuck.touch()
        pending_insert = kitchen.send(point("l9"))
        assert port.until("live", 503) == "stuck: solver kitchen\n"
        assert port.get("ready")[0] == 503
        assert manager.silent_of("WATCHDOG=1", 1.5)
        assert "solver kitchen" in manager.hear("STATUS=stuck")
        samples = port.metrics()
        assert samples[("factorbus_alive",)] == 0
        assert samples[("factorbus_silent_seconds", "solver kitchen")] > STUCK_S
        with bare(endpoint) as other:
            tokens = {str(r.ok.key_expr) for r in other.session.liveliness().get(f"{keys.PREFIX}/map/*/live/service/*")}
        assert {token.split("/")[3] for token in tokens} == {"hall"}, "alive means askable"
        told = stats(endpoint)
        assert (told.returncode, "stuck: solver kitchen" in told.stdout) == (1, True)
        assert "stuck: solver kitchen" in doctor(endpoint)
        assert hall.insert(Draft().se2("x0", (0, 0, 0), fixed=True)).revision == 1, "the other map goes on"
        assert not pending_insert.done()
        stuck.unlink()
        assert pending_insert.result(60).sequence
        port.until("live", 200)
        manager.hear("WATCHDOG=1")
        assert port.metrics()[("factorbus_alive",)] == 1
    service.signal(signal.SIGTERM)
    manager.hear("STOPPING=1")
    assert service.wait() == 0


def test_a_frozen_process_feeds_no_watchdog(spawn: Spawn, manager: Manager) -> None:
    service = spawn("-m", "factorbus.cli", "serve", "--no-warm", "--listen", "tcp/127.0.0.1:0")
    service.ready()
    manager.hear("WATCHDOG=1")
    service.signal(signal.SIGSTOP)
    assert manager.silent_of("WATCHDOG=1", 1.5)
    service.signal(signal.SIGCONT)
    manager.hear("WATCHDOG=1")


def test_a_worker_says_that_it_is_ready(endpoint: str, spawn: Spawn, manager: Manager) -> None:
    worker = spawn("-m", "factorbus.cli", "work", "--no-warm", "--connect", endpoint, "--name", "notified")
    assert "worker notified" in manager.hear("READY=1")
    worker.signal(signal.SIGTERM)
    manager.hear("STOPPING=1")
    assert worker.wait() == 0


def test_the_metrics_are_what_happened(tmp_path: Path, spawn: Spawn) -> None:
    port = Port()
    command = ("serve", "--no-warm", "--listen", "tcp/127.0.0.1:0", "--metrics", port.where, "--map", "kitchen")
    service = spawn("-m", "factorbus.cli", *command, "--log", "json")
    endpoint = service.ready()[0]
    spawn("-m", "factorbus.cli", "work", "--no-warm", "--connect", endpoint, "--name", "w1", "--slots", "3").ready()
    with connect(endpoint, timeout_s=60) as bus, bus.map("kitchen", mirror=False) as kitchen:
        for n in range(10):
            kitchen.insert(point(f"l{n}"))
        with pytest.raises(Exception, match="l3"):
            kitchen.insert(point("l3"))
    samples = port.metrics(("factorbus_worker_slots", "w1"))
    of = ("kitchen",)
    assert samples[("factorbus_map_variables", *of)] == samples[("factorbus_steps_total", *of)] == 10
    assert samples[("factorbus_inserts_total", "accepted", *of)] == 10
    assert samples[("factorbus_refusals_total", "duplicate_variable", *of)] == 1
    assert samples[("factorbus_step_seconds_count", *of)] == 10
    assert samples[("factorbus_insert_seconds_count", *of)] == 11
    assert samples[("factorbus_insert_seconds_bucket", "+Inf", *of)] == 11
    assert samples[("factorbus_bytes_total", *of, "received")] > 10 * 100
    assert samples[("factorbus_worker_slots", "w1")] == 3
    assert samples[("factorbus_memory_bytes",)] > 50 << 20
    assert port.get("elsewhere")[0] == 404
    service.signal(signal.SIGTERM)
    service.wait()
    lines = [json.loads(line) for line in (tmp_path / "0.log").read_text().splitlines()]
    assert {"time", "level", "logger", "message", "map"} <= set(next(each for each in lines if each.get("map")))


def test_an_idle_connection_to_the_metrics_port_holds_nobody_up(spawn: Spawn) -> None:
    port = Port()
    spawn("-m", "factorbus.cli", "serve", "--no-warm", "--listen", "tcp/127.0.0.1:0", "--metrics", port.where).ready()
    host, number = port.where.split(":")
    idle = [socket.create_connection((host, int(number)), timeout=PATIENCE_S) for _ in range(12)]
    assert port.get("live") == (200, "ok\n")
    for each in idle:
        each.close()


def stats(endpoint: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "factorbus.cli", "stats", "--connect", endpoint]
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, env=quiet())


def doctor(endpoint: str) -> str:
    program = "import sys; from factorbus.cli.doctor.service_checks import services; print(*services(sys.argv[1], ''))"
    ran = subprocess.run([sys.executable, "-c", program, endpoint], capture_output=True, text=True, timeout=PATIENCE_S)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def quiet() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if name != "NOTIFY_SOCKET"}
