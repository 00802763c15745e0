"""What a link to a viewer carries while a robot drives: all of the map, and interests in parts of it.

    python tests/bench/interest.py [--world manhattan] [--poses 600] [--inserts-per-s 10] [--json]

Each viewer reaches the service over a relay of its own, which counts the bytes of the TCP stream both ways: messages,
Zenoh's frames and signs of life, questions and answers.  A robot drives a simulated world in real time.
"""

import argparse
import json
import socket
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from sizing import PATIENCE_S, WARM_UP, service

from factorbus.client import Interest, connect
from factorbus.simulate import WORLDS

VIEWERS: dict[str, Interest | None] = {
    "all of it": None,
    "all, once a second": Interest(period_ms=1000),
    "a box of 20 m x 20 m": Interest(box=(-10.0, -10.0, 10.0, 10.0)),
    "the box, once a second": Interest(box=(-10.0, -10.0, 10.0, 10.0), period_ms=1000),
    "another robot's letter": Interest("y"),
    "all, at most 4,000 bytes/s": Interest(period_ms=500, bytes_per_s=4000),
    "all, at most 1,000 bytes/s": Interest(period_ms=1000, bytes_per_s=1000),
}


class Relay:
    """A TCP port that hands on what comes to another one, and counts."""

    def __init__(self, endpoint: str) -> None:
        host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
        self._to = host, int(port)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._server.getsockname()[1]}"
        self.bytes = {"down": 0, "up": 0}
        self._sockets = [self._server]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """End all connections."""
        for each in self._sockets:
            with suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._server.accept()
                upstream = socket.create_connection(self._to)
                self._sockets += [client, upstream]
                for source, sink, way in ((client, upstream, "up"), (upstream, client, "down")):
                    threading.Thread(target=self._hand_on, args=(source, sink, way), daemon=True).start()

    def _hand_on(self, source: socket.socket, sink: socket.socket, way: str) -> None:
        with suppress(OSError):
            while data := source.recv(1 << 16):
                self.bytes[way] += len(data)
                sink.sendall(data)


def run(world: str, poses: int, inserts_per_s: float, seed: int = 1) -> dict[str, Any]:
    """Bytes of each viewer's link."""
    with service() as (endpoint, _), ExitStack() as stack:
        bus = stack.enter_context(connect(endpoint, client="robot"))
        with bus.map("warm-up") as warm_up:
            for step in WORLDS[world](WARM_UP, seed):
                warm_up.insert(step.batch, timeout_s=PATIENCE_S)
        bus.drop("warm-up")
        driven = stack.enter_context(bus.map("driven", mirror=False))
        viewers = []
        for number, (name, interest) in enumerate(VIEWERS.items()):
            relay = Relay(endpoint)
            stack.callback(relay.close)
            seen = stack.enter_context(connect(relay.endpoint, client=f"viewer{number}", timeout_s=PATIENCE_S))
            viewers.append((name, relay, seen.map("driven", interest=interest)))
        before = [dict(relay.bytes) for _, relay, _ in viewers]
        began, most_waiting = time.monotonic(), dict.fromkeys(VIEWERS, 0)
        for number, step in enumerate(WORLDS[world](poses, seed)):
            driven.insert(step.batch, timeout_s=PATIENCE_S)
            for name, _, joined in viewers:
                most_waiting[name] = max(most_waiting[name], joined.estimate.waiting)
            threading.Event().wait(max(began + (number + 1) / inserts_per_s - time.monotonic(), 0.0))
        seconds = time.monotonic() - began
        rows = [
            {
                "viewer": name,
                "down_bytes": relay.bytes["down"] - at["down"],
                "up_bytes": relay.bytes["up"] - at["up"],
                "down_bytes_per_s": round((relay.bytes["down"] - at["down"]) / seconds, 1),
                "message_bytes": joined.estimate.received_bytes,
                "variables": len(joined.estimate),
                "most_waiting": most_waiting[name],
                "waiting": joined.estimate.waiting,
            }
            for (name, relay, joined), at in zip(viewers, before, strict=True)
        ]
        streams = bus.stats()[0]["interests"]
    return {"world": world, "poses": poses, "seconds": round(seconds, 1), "rows": rows, "streams": streams}


def table(result: dict[str, Any]) -> str:
    """The result for a person."""
    lines = [f"{'viewer':<28}{'KB down':>9}{'bytes/s':>9}{'KB up':>8}{'variables':>11}{'most waiting':>14}"]
    lines += [
        f"{row['viewer']:<28}{row['down_bytes'] / 1e3:>9.1f}{row['down_bytes_per_s']:>9,.0f}"
        f"{row['up_bytes'] / 1e3:>8.1f}{row['variables']:>11,}{row['most_waiting']:>14,}"
        for row in result["rows"]
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--world", choices=sorted(WORLDS), default="manhattan")
    parser.add_argument("--poses", type=int, default=600)
    parser.add_argument("--inserts-per-s", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    result = run(given.world, given.poses, given.inserts_per_s)
    print(json.dumps(result) if given.json else table(result))


if __name__ == "__main__":
    main()
