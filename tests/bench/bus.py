"""What the bus costs: an insert of 10 factors and its delta back, against a bare Zenoh echo of equal sizes.

    python tests/bench/bus.py [--rounds N] [--samples N] [--json]

Ours: a client process (this one) sends the bytes of an insert and waits until it has the bytes of both the answer and
the delta; the time inside the solver (`solver_ms` of the delta's report: staging, step, what changed) is taken off.
The floor: the same bytes to a process that has nothing but a callback which replies and publishes as many bytes as
ours did, over the same Zenoh configuration.  What the client needs to encode the insert and decode both messages is
given beside it.

All hubs run all the time and are asked in turn, BLOCK exchanges each, in an order that changes.  So they share whatever
else the machine does.  Every exchange follows one with the same hub, as the first of each turn is not counted: after
another hub, an exchange also pays for what that has driven out of the caches, or gains from the cores that it has kept
awake.

Around every exchange, with whichever hub, the client does the same: before it makes an insert and encodes it, after it
decodes an answer and a delta.  That is not in the time, but it decides what is in the caches of the client when it
asks, and for how long hub and link have rested, and neither is the service's doing.

Beside the floor there are three more echoes, to see where a difference comes from:

`idle` leaves that work out: a client that does nothing between its exchanges, with the hub of the floor.

`held` first keeps a core busy for as long as the solver did, and that time is taken off: what being busy in between
costs by itself (threads that have gone to sleep, a second core that is taken).  It uses the hub of the floor.

`laid out` has Zenoh's threads laid out as the service has them (`RUNTIME` in the service's settings), which is no part
of a Zenoh configuration but of a process, and which a bare echo gains from as well.

Goal: ratio of p50 and of p99 to the floor at most 1.3.
"""

import argparse
import gc
import hashlib
import json
import os
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import zenoh
from bus_graph import FACTORS, edges, ring
from zenoh.handlers import Callback

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Delta, Insert
from factorbus.service.bus.zenoh_config import RUNTIME, RUNTIME_VARIABLE

GOAL = 1.3
FLOOR = "floor/echo"
BLOCK = 25
WARM_UP = 10


@dataclass(frozen=True, slots=True)
class Sample:
    """One exchange in µs: from bytes to bytes, the solver's part of that, the client's codec; bytes of both answers."""

    total: float
    solver: float
    codec: float
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
        process(__file__, "--echo", **{RUNTIME_VARIABLE: RUNTIME}) as laid_out,
        session(ours) as to_ours,
        session(floor) as to_floor,
        session(laid_out) as to_laid_out,
    ):
        client, echoes = Client(to_ours), (Echo(to_floor), Echo(to_laid_out))
        gc.collect()
        gc.freeze()
        taken = [one_round(client, *echoes, f"bench{n}", samples) for n in range(rounds)]
    bus = [np.array([s.bus for s in row.ours]) for row in taken]
    bare, idle, held, laid = (
        [np.array(getattr(row, name)) for row in taken] for name in ("bare", "idle", "held", "laid_out")
    )
    every = [s for row in taken for s in row.ours]
    answer, delta = every[-1].sizes
    return {
        "rounds": rounds,
        "samples": len(every),
        "bytes": {"insert": len(client.payload), "answer": answer, "delta": delta},
        "bus_us": percentiles(np.concatenate(bus)),
        "floor_us": percentiles(np.concatenate(bare)),
        "idle_us": percentiles(np.concatenate(idle)),
        "held_us": percentiles(np.concatenate(held)),
        "laid_out_us": percentiles(np.concatenate(laid)),
        "solver_us": percentiles(np.array([s.solver for s in every])),
        "client_codec_us": percentiles(np.array([s.codec for s in every])),
        "ratio": {f"p{q}": round(ratio(bus, bare, q), 3) for q in (50, 90, 99)},
        "ratio_idle": {f"p{q}": round(ratio(bus, idle, q), 3) for q in (50, 90, 99)},
        "ratio_held": {f"p{q}": round(ratio(bus, held, q), 3) for q in (50, 90, 99)},
        "ratio_laid_out": {f"p{q}": round(ratio(bus, laid, q), 3) for q in (50, 90, 99)},
        "goal": GOAL,
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0],
    }


def ratio(bus: list[np.ndarray], bare: list[np.ndarray], q: float) -> float:
    """Of the percentile over all samples for the rare ones; for p50 the median over rounds of each round's ratio."""
    if q <= 50:
        return float(np.median([np.percentile(a, q) / np.percentile(b, q) for a, b in zip(bus, bare, strict=True)]))
    return float(np.percentile(np.concatenate(bus), q) / np.percentile(np.concatenate(bare), q))


@dataclass(frozen=True, slots=True)
class Round:
    """What one round took: ours, and µs of the echoes."""

    ours: list[Sample]
    bare: list[float]
    idle: list[float]
    held: list[float]
    laid_out: list[float]


def one_round(client: "Client", echo: "Echo", laid_out: "Echo", name: str, samples: int) -> Round:
    """Every block has a new map, so that the solver's part stays small."""
    taken = Round([], [], [], [], [])
    hold_us = 0.0
    turns: list[tuple[list[Any], Callable[[], Any]]] = [
        (taken.ours, client.exchange),
        (taken.bare, lambda: client.at_work(echo.exchange)),
        (taken.idle, lambda: echo.exchange(client.payload)),
        (taken.held, lambda: client.at_work(echo.exchange, hold_us)),
        (taken.laid_out, lambda: client.at_work(laid_out.exchange)),
    ]
    for block in range(-(-samples // BLOCK)):
        with client.joined(f"{name}-{block}"):
            warm_up = [client.exchange() for _ in range(WARM_UP)]
            hold_us = float(np.median([sample.solver for sample in warm_up]))
            for hub in (echo, laid_out):
                hub.answer_with(warm_up[-1].sizes)
            for turn in client.random.permutation(len(turns)):
                samples_of_hub, exchange = turns[turn]
                exchange()
                samples_of_hub += [exchange() for _ in range(BLOCK)]
    return taken


class Client:
    """Inserts into a map over a bare session."""

    def __init__(self, bus: zenoh.Session) -> None:
        self._bus, self._came = bus, queue.SimpleQueue()
        self.random = np.random.default_rng(1)
        self.payload = b""
        self._last: dict[str, bytes] = {}

    @contextmanager
    def joined(self, name: str) -> Iterator[None]:
        """A map of POSES poses on a ring, and its deltas."""
        self._ask(keys.admin_key("create"), codec.encode_map({"map": name}))
        self._key, self._sequence = self._bus.declare_keyexpr(keys.insert_key(name, "bench")), 0
        with self._bus.declare_subscriber(keys.delta_key(name), Callback(self._on_delta, indirect=False)):
            self._insert(ring())
            yield
        self._ask(keys.admin_key("drop"), codec.encode_map({"map": name}))

    def exchange(self) -> Sample:
        """Ten more factors between the poses."""
        return self._insert(Batch(factors=(edges(self.random),)))

    def at_work(self, exchange: Callable[..., float], *how: float) -> float:
        """An exchange of an insert with another hub, with the work around it that one of ours has."""
        microseconds = exchange(codec.encode_insert(Insert(self._sequence, Batch(factors=(edges(self.random),)))), *how)
        self._decode(self._last)
        return microseconds

    def _insert(self, batch: Batch) -> Sample:
        self._sequence += 1
        times = [time.perf_counter()]
        self.payload = codec.encode_insert(Insert(self._sequence, batch))
        times.append(time.perf_counter())
        ask(self._bus, self._key, self._on_reply, payload=self.payload)
        came = dict(self._came.get(timeout=30) for _ in range(2))
        times.append(time.perf_counter())
        if "problem" in came:
            raise codec.decode_problem(came["problem"])
        delta, self._last = self._decode(came), came
        times.append(time.perf_counter())
        encoding, total, decoding = np.diff(times) * 1e6
        sizes = len(came["answer"]), len(came["delta"])
        return Sample(total, delta.report["solver_ms"] * 1e3, encoding + decoding, sizes)

    def _decode(self, came: dict[str, bytes]) -> Delta:
        codec.decode_accepted(came["answer"])
        return codec.decode_delta(came["delta"])

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

    def answer_with(self, sizes: tuple[int, int]) -> None:
        """Bytes of answer and publication from now on."""
        for _ in self._bus.get(f"{FLOOR}/sizes", payload=json.dumps(sizes)):
            pass

    def exchange(self, payload: bytes, hold_us: float = 0.0) -> float:
        """Microseconds until answer and publication are here, less those it was to hold them."""
        start = time.perf_counter()
        if hold_us:
            ask(self._bus, f"{FLOOR}/held", self._on_reply, payload=payload, attachment=f"{hold_us:.0f}")
        else:
            ask(self._bus, f"{FLOOR}/in", self._on_reply, payload=payload)
        for _ in range(2):
            self._came.get(timeout=30)
        return (time.perf_counter() - start) * 1e6 - hold_us

    def _on_reply(self, reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._came.put(reply.ok.payload.to_bytes())

    def _on_delta(self, sample: zenoh.Sample) -> None:
        self._came.put(sample.payload.to_bytes())


def ask(bus: zenoh.Session, key: zenoh.KeyExpr | str, on_reply: Callable[[zenoh.Reply], None], **what: Any) -> None:
    """A query as the client library sends it: the reply is handed on without waiting for the end of the query.

    The library also declares the key of its inserts; the floor, as bare as it is, does not.
    """
    bus.get(
        key,
        Callback(on_reply, indirect=False),
        consolidation=zenoh.ConsolidationMode.NONE,
        allowed_destination=zenoh.Locality.REMOTE,
        **what,
    )


def echo() -> None:
    """The other side of the floor: nothing but Zenoh, as the service configures it."""
    from factorbus.service.bus.zenoh_config import zenoh_settings
    from factorbus.service.config import Config

    stop = threading.Event()
    settings = zenoh.Config()
    for path, value in zenoh_settings(Config(listen=("tcp/127.0.0.1:0",))).items():
        settings.insert_json5(path, json.dumps(value))
    with zenoh.open(settings) as bus:
        publisher = bus.declare_publisher(f"{FLOOR}/out")
        answers: dict[str, bytes] = {}
        block = bytes(8192)

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

        def on_held(query: zenoh.Query) -> None:
            until = time.perf_counter()
            if query.attachment is not None:
                until += float(query.attachment.to_string()) * 1e-6
            while time.perf_counter() < until:
                hashlib.sha256(block)  # without the interpreter lock, like the solver
            on_query(query)

        bus.declare_queryable(f"{FLOOR}/held", Callback(on_held, indirect=False))
        bus.declare_queryable(f"{FLOOR}/sizes", Callback(on_sizes, indirect=False))
        bus.declare_queryable(f"{FLOOR}/in", Callback(on_query, indirect=False))
        gc.collect()
        gc.freeze()
        (reply,) = [r for r in bus.get(f"@/{bus.info.zid()}/*") if r.ok is not None]
        print("ready", *json.loads(reply.ok.payload.to_bytes())["locators"], flush=True)  # type: ignore[union-attr]
        threading.Thread(target=lambda: (sys.stdin.read(), stop.set()), daemon=True).start()
        stop.wait()


def percentiles(values: np.ndarray) -> dict[str, float]:
    """p50, p90, p99."""
    return {f"p{q}": round(float(np.percentile(values, q)), 1) for q in (50, 90, 99)}


@contextmanager
def process(*arguments: str, **environment: str) -> Iterator[str]:
    """A Python process that prints `ready ENDPOINT`; it is ended by SIGTERM."""
    command, pipe = [sys.executable, *arguments], subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stdin=pipe, text=True, env=os.environ | environment) as p:
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
    for what, row in (
        ("ours without solver", "bus_us"),
        ("bare Zenoh echo", "floor_us"),
        ("the same, client idle", "idle_us"),
        ("the same, held", "held_us"),
        ("the same, laid out", "laid_out_us"),
        ("solver", "solver_us"),
        ("client's codec", "client_codec_us"),
    ):
        lines.append(f"{what:24}" + "".join(f"{result[row][p]:9.0f}" for p in ("p50", "p90", "p99")))
    for what, row in (
        ("ratio to the echo", "ratio"),
        ("ratio to that idle", "ratio_idle"),
        ("ratio to the held one", "ratio_held"),
        ("ratio to that laid out", "ratio_laid_out"),
    ):
        lines.append(f"{what:24}" + "".join(f"{result[row][p]:9.2f}" for p in ("p50", "p90", "p99")))
    return "\n".join([*lines, f"goal: ratio to the echo, p50 and p99, at most {GOAL}; load {result['load']:.1f}"])


def main() -> int:
    """Run it; 1 when the goal is missed."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=32)
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
