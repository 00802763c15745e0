"""A client that does what none should: hostile.py ENDPOINT MAP WAY → `ready`; at a line on standard input `sent COUNT`

garbage     bytes that are no messages, as fast as they go
unread      inserts whose answers it never takes: its receiving thread hangs
questions   for the whole estimate and graph, as fast as they go, and does not take the answers either
large       inserts of 20,000 poses that are refused in the end, one after the other
names       every insert under a new name
window      good inserts, 200 in flight, again and again
"""

import itertools
import sys
import threading
import time

import numpy as np
from zenoh.handlers import Callback

sys.path.insert(0, __file__.rpartition("/system/")[0])
from bare import INFORMATION, bare

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Factors, Insert, Variables

IN_FLIGHT = 200


class Hostile:
    """One session and its ways."""

    def __init__(self, session: object, name: str) -> None:
        self.session, self.map = session, name
        self.stop, self.hang = threading.Event(), False
        self.room = threading.Semaphore(IN_FLIGHT)
        self.sent = 0

    def send(self, key: str, payload: bytes, timeout_s: float = 20.0) -> None:
        """A query; waits only while as many are out as would be read."""
        if not self.hang:
            self.room.acquire(timeout=5)

        def on_reply(_: object) -> None:
            if self.hang:
                self.stop.wait()

        drop = (lambda: None) if self.hang else self.room.release
        self.session.get(key, Callback(on_reply, drop=drop, indirect=False), payload=payload, timeout=timeout_s)  # type: ignore[attr-defined]
        self.sent += 1

    def insert(self, client: str, sequence: int, batch: Batch) -> None:
        self.send(keys.insert_key(self.map, client), codec.encode_insert(Insert(sequence, batch)))

    def garbage(self, n: int) -> None:
        self.send(keys.insert_key(self.map, "bad-1"), np.random.default_rng(n).bytes(200))

    def unread(self, n: int) -> None:
        self.hang = True
        self.send(keys.insert_key(self.map, "bad-1"), b"\x81\xa4what\xd9\xc8" + b"x" * 200)
        if n % 500 == 499:
            time.sleep(0.01)  # a flood that its own machine can keep up

    def questions(self, n: int) -> None:
        self.hang = True
        self.send(keys.ask_key(self.map, ("estimate", "graph", "export", "stats")[n % 4]), b"")
        if n % 50 == 49:
            time.sleep(0.01)  # a flood that its own machine can keep up

    def large(self, n: int) -> None:
        own = np.arange(20_000) + (ord("h") << 56)
        edges = np.stack([own[:-1], own[1:]], axis=1)
        measured = np.tile([1.0, 0, 0], (len(edges), 1))
        factors = Factors("between_se2", edges, measured, np.tile(INFORMATION, (len(edges), 1)))
        held_by_nothing = Batch((Variables("se2", own, np.zeros((20_000, 3))),), (factors,))
        self.insert("bad-1", n + 1, held_by_nothing)

    def names(self, n: int) -> None:
        self.insert(f"bad-{n}", 1, Batch((Variables("point2", np.array([n]), None),)))

    def window(self, n: int) -> None:
        own = np.array([n + (ord("w") << 56)])
        start = Variables("se2", own, np.zeros((1, 3)), fixed=True)
        self.insert("bad-1", n + 1, Batch((start,)))


def main() -> None:
    endpoint, name, way = sys.argv[1:]
    with bare(endpoint) as line:
        hostile = Hostile(line.session, name)
        act = getattr(hostile, way)

        def go() -> None:
            for n in itertools.count():
                if hostile.stop.is_set():
                    return
                act(n)
                if n == 20:
                    print("ready", flush=True)

        thread = threading.Thread(target=go, daemon=True)
        thread.start()
        sys.stdin.readline()
        hostile.stop.set()
        print("sent", hostile.sent, flush=True)


if __name__ == "__main__":
    main()
