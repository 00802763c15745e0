"""What the bus costs: an insert of 10 factors and its delta back, against a bare Zenoh echo of equal sizes.

    python tests/bench/bus.py [--rounds N] [--samples N] [--json]

Ours: a client process (this one) encodes an insert, sends it, waits until it has both the answer and the delta, and
decodes them; the solver's own time (staging and step, `solver_ms` of the report) is taken off.  The floor: the same
bytes to a process that has nothing but a callback which replies and publishes as many bytes as ours did.  Both hubs
run all the time and are asked in turn, sample by sample, so that they share whatever else the machine does.

Goal: ratio of p50 and of p99 at most 1.3.
"""

import argparse
import gc
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import Callback

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Factors, Insert, Variables
from factorbus.proto.symbols import symbol

GOAL = 1.3
POSES = 10
FACTORS = 10
FLOOR = "floor/echo"


@dataclass(frozen=True, slots=True)
class Sample:
    """One exchange: how long it took (µs), how much of that was the solver, bytes of answer and delta."""

    total: float
    solver: float
    sizes: tuple[int, int]

    @property
    def bus(self) -> float:
        """What is left without the solver."""
        return self.total - self.solver


def run(rounds: int, samples: int) -> dict[str, Any]:
    """Measure; times in microseconds."""
    with (
        process("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0") as ours,
        process(__file__, "--echo") as floor,
        session(ours) as to_ours,
        session(floor) as to_floor,
    ):
        client, echo = Client(to_ours), Echo(to_floor)
        gc.collect()
        gc.freeze()
        pairs = [one_round(client, echo, f"bench{n}", samples) for n in range(rounds)]
    bus = [np.array([sample.bus for sample, _ in pair]) for pair in pairs]
    bare = [np.array([t for _, t in pair]) for pair in pairs]
    solver = np.array([sample.solver for pair in pairs for sample, _ in pair])
    insert, (answer, delta) = client.insert_size, pairs[-1][-1][0].sizes
    return {
        "rounds": rounds,
        "samples": rounds * samples,
        "bytes": {"insert": insert, "answer": answer, "delta": delta},
        "bus_us": percentiles(np.concatenate(bus)),
        "floor_us": percentiles(np.concatenate(bare)),
        "solver_us": percentiles(solver),
        "ratio": {name: ratio(bus, bare, q) for name, q in (("p50", 50), ("p90", 90), ("p99", 99))},
        "goal": GOAL,
        "cores": os.cpu_count(),
    }


def ratio(bus: list[np.ndarray], bare: list[np.ndarray], q: float) -> float:
    """Of the percentile over all samples for the rare ones; for p50 the median over rounds of each round's ratio."""
    if q <= 50:
        return float(np.median([np.percentile(a, q) / np.percentile(b, q) for a, b in zip(bus, bare, strict=True)]))
    return float(np.percentile(np.concatenate(bus), q) / np.percentile(np.concatenate(bare), q))


def one_round(client: "Client", echo: "Echo", name: str, samples: int) -> list[tuple[Sample, float]]:
    """A new map, so that the solver's part stays small; the first exchanges are not counted."""
    with client.joined(name):
        for _ in range(20):
            warm_up = client.exchange()
        echo.exchange(b"", warm_up.sizes)
        return [(sample := client.exchange(), echo.exchange(client.payload, sample.sizes)) for _ in range(samples)]


class Client:
    """Inserts into a map over a bare session."""

    def __init__(self, bus: zenoh.Session) -> None:
        self._bus, self._came = bus, queue.SimpleQueue()
        self._random = np.random.default_rng(1)
        self.payload, self.insert_size = b"", 0

    @contextmanager
    def joined(self, name: str) -> Iterator[None]:
        """A map of POSES poses on a ring, and its deltas."""
        self._ask(keys.admin_key("create"), codec.encode_map({"map": name}))
        self._key, self._sequence = keys.insert_key(name, "bench"), 0
        with self._bus.declare_subscriber(keys.delta_key(name), Callback(self._on_delta, indirect=False)):
            self._insert(ring())
            yield
        self._ask(keys.admin_key("drop"), codec.encode_map({"map": name}))

    def exchange(self) -> Sample:
        """Ten more factors between the poses."""
        batch = Batch(factors=(edges(self._random),))
        start = time.perf_counter()
        sizes, solver_ms = self._insert(batch)
        return Sample((time.perf_counter() - start) * 1e6, solver_ms * 1e3, sizes)

    def _insert(self, batch: Batch) -> tuple[tuple[int, int], float]:
        self._sequence += 1
        self.payload = codec.encode_insert(Insert(self._sequence, batch))
        self.insert_size = len(self.payload)
        self._bus.get(self._key, Callback(self._on_reply, indirect=False), payload=self.payload)
        sizes: dict[str, int] = {}
        solver_ms = 0.0
        while len(sizes) < 2:
            what, message = self._came.get(timeout=30)
            if what == "problem":
                raise codec.decode_problem(message)
            answer = codec.decode_accepted(message) if what == "answer" else codec.decode_delta(message)
            solver_ms, sizes[what] = answer.report["solver_ms"], len(message)
        return (sizes["answer"], sizes["delta"]), solver_ms

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is None:
            self._came.put(("problem", reply.err.payload.to_bytes() if reply.err else b""))
        else:
            self._came.put(("answer", reply.ok.payload.to_bytes()))

    def _on_delta(self, sample: zenoh.Sample) -> None:
        self._came.put(("delta", sample.payload.to_bytes()))

    def _ask(self, key: str, payload: bytes) -> None:
        for reply in self._bus.get(key, payload=payload):
            if reply.ok is None:
                raise codec.decode_problem(reply.err.payload.to_bytes() if reply.err else b"")


class Echo:
    """The floor, from the asking side."""

    def __init__(self, bus: zenoh.Session) -> None:
        self._bus, self._came = bus, queue.SimpleQueue()
        self._subscriber = bus.declare_subscriber(f"{FLOOR}/out", Callback(self._on_delta, indirect=False))

    def exchange(self, payload: bytes, sizes: tuple[int, int]) -> float:
        """Microseconds until answer and publication are here; a message of no bytes sets the sizes of both."""
        start = time.perf_counter()
        if payload:
            self._bus.get(f"{FLOOR}/in", Callback(self._on_reply, indirect=False), payload=payload)
            for _ in range(2):
                self._came.get(timeout=30)
        else:
            for _ in self._bus.get(f"{FLOOR}/sizes", payload=json.dumps(sizes)):
                pass
        return (time.perf_counter() - start) * 1e6

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._came.put(reply.ok.payload.to_bytes())

    def _on_delta(self, sample: zenoh.Sample) -> None:
        self._came.put(sample.payload.to_bytes())


def echo() -> None:
    """The other side of the floor: nothing but Zenoh, as the service configures it."""
    from factorbus.service.config import Config
    from factorbus.service.settings import zenoh_settings

    stop = threading.Event()
    settings = zenoh.Config()
    for path, value in zenoh_settings(Config(listen=("tcp/127.0.0.1:0",))).items():
        settings.insert_json5(path, json.dumps(value))
    with zenoh.open(settings) as bus:
        publisher = bus.declare_publisher(f"{FLOOR}/out")
        answers: dict[str, bytes] = {}

        def on_sizes(query: zenoh.Query) -> None:
            with query:
                answer, delta = json.loads(query.payload.to_bytes() if query.payload else b"")
                answers.update(answer=bytes(answer), delta=bytes(delta))
                query.reply(query.key_expr, b"")

        def on_query(query: zenoh.Query) -> None:
            with query:
                if query.payload is not None:
                    query.payload.to_bytes()
                query.reply(query.key_expr, answers["answer"])
            publisher.put(answers["delta"])

        bus.declare_queryable(f"{FLOOR}/sizes", Callback(on_sizes, indirect=False))
        bus.declare_queryable(f"{FLOOR}/in", Callback(on_query, indirect=False))
        gc.collect()
        gc.freeze()
        (reply,) = [r for r in bus.get(f"@/{bus.info.zid()}/*") if r.ok is not None]
        print("ready", *json.loads(reply.ok.payload.to_bytes())["locators"], flush=True)  # type: ignore[union-attr]
        threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
        stop.wait()


def ring() -> Batch:
    """POSES poses on a circle, the first one fixed, each tied to the next."""
    angles = 2 * np.pi * np.arange(POSES) / POSES
    values = np.column_stack([np.cos(angles), np.sin(angles), angles])
    names = np.array([symbol("x", n) for n in range(POSES)])
    variables = (Variables("se2", names[:1], values[:1], fixed=True), Variables("se2", names[1:], values[1:]))
    return Batch(variables, (Factors("between_se2", *columns(names[:-1], names[1:], values[:-1], values[1:])),))


def edges(random: np.random.Generator) -> Factors:
    """FACTORS noisy edges between poses of the ring."""
    first = random.integers(0, POSES, FACTORS)
    second = (first + random.integers(1, POSES, FACTORS)) % POSES
    angles = 2 * np.pi * np.arange(POSES) / POSES
    values = np.column_stack([np.cos(angles), np.sin(angles), angles])
    names = np.array([symbol("x", n) for n in range(POSES)])
    ends, measured, information = columns(names[first], names[second], values[first], values[second])
    return Factors("between_se2", ends, measured + random.normal(0, 0.01, measured.shape), information)


def columns(i: np.ndarray, j: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keys, measurements b in a's frame, and information of edges from i to j."""
    c, s, d = np.cos(a[:, 2]), np.sin(a[:, 2]), b - a
    measured = np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]])
    information = np.tile([100.0, 0, 0, 100, 0, 400], (len(a), 1))
    return np.column_stack([i, j]), measured, information


def percentiles(values: np.ndarray) -> dict[str, float]:
    """p50, p90, p99."""
    return {f"p{q}": round(float(np.percentile(values, q)), 1) for q in (50, 90, 99)}


@contextmanager
def process(*arguments: str) -> Iterator[str]:
    """A Python process that prints `ready ENDPOINT`; it is ended by SIGTERM."""
    with subprocess.Popen([sys.executable, *arguments], stdout=subprocess.PIPE, stdin=subprocess.PIPE, text=True) as p:
        try:
            line = p.stdout.readline() if p.stdout else ""
            if not line.startswith("ready "):
                raise RuntimeError(f"{' '.join(arguments)} did not get ready: {line!r}")
            yield line.split()[1]
        finally:
            p.terminate()
            p.wait(10)


@contextmanager
def session(endpoint: str) -> Iterator[zenoh.Session]:
    """A client's session."""
    settings = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        settings.insert_json5(path, json.dumps(value))
    with zenoh.open(settings) as opened:
        yield opened


def table(result: dict[str, Any]) -> str:
    """The result for a person."""
    size = result["bytes"]
    lines = [
        f"insert of {FACTORS} factors ({size['insert']} B), answer ({size['answer']} B) and delta ({size['delta']} B) "
        f"back; {result['samples']} samples, µs",
        f"{'':24}{'p50':>9}{'p90':>9}{'p99':>9}",
    ]
    for what, row in (("ours without solver", "bus_us"), ("bare Zenoh echo", "floor_us"), ("solver", "solver_us")):
        lines.append(f"{what:24}" + "".join(f"{result[row][p]:9.0f}" for p in ("p50", "p90", "p99")))
    lines.append(f"{'ratio':24}" + "".join(f"{result['ratio'][p]:9.2f}" for p in ("p50", "p90", "p99")))
    return "\n".join([*lines, f"goal: p50 and p99 at most {GOAL}"])


def main() -> int:
    """Run it; 1 when the goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=8)
    parser.add_argument("--samples", type=int, default=250)
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")
    parser.add_argument("--echo", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.echo:
        echo()
        return 0
    result = run(options.rounds, options.samples)
    print(json.dumps(result) if options.json else table(result))
    return 0 if max(result["ratio"]["p50"], result["ratio"]["p99"]) <= GOAL else 1


if __name__ == "__main__":
    sys.exit(main())
