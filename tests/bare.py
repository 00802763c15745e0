"""A client with nothing but Zenoh and the codec: what the tests use to send what no library would."""

import json
import queue
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import Callback

from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import Refused
from factorbus.proto.symbols import parse_symbol

PATIENCE_S = 60.0
INFORMATION = [100.0, 0, 0, 100, 0, 400]


class Bare:
    """A session that asks and gets bytes."""

    def __init__(self, session: zenoh.Session) -> None:
        self.session = session

    def ask(self, key: str, payload: bytes = b"") -> bytes | Refused | None:
        """The reply's bytes, the problem, or None for silence."""
        came = self.send(key, payload)
        return came.get(timeout=PATIENCE_S)

    def send(self, key: str, payload: bytes = b"") -> "queue.SimpleQueue[bytes | Refused | None]":
        """Where the reply will be, as above; None comes after every reply, too."""
        came: queue.SimpleQueue[bytes | Refused | None] = queue.SimpleQueue()

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None:
                came.put(reply.ok.payload.to_bytes())
            else:
                came.put(codec.decode_problem(reply.err.payload.to_bytes() if reply.err else b""))

        self.session.get(
            key,
            Callback(on_reply, drop=lambda: came.put(None), indirect=False),
            payload=payload,
            timeout=PATIENCE_S,
            # Not what this very session says of itself, below @/<its id>/session.
            allowed_destination=zenoh.Locality.REMOTE,
        )
        return came

    def create(self, name: str) -> dict[str, Any]:
        """The row of the map."""
        answer = self.ask(keys.admin_key("create"), codec.encode_map({"map": name}))
        assert isinstance(answer, bytes), answer
        return codec.decode_map(answer)

    def estimate(self, name: str) -> bytes:
        """The whole estimate: epoch, revision and values, bit for bit."""
        answer = self.ask(keys.ask_key(name, "estimate"))
        assert isinstance(answer, bytes), answer
        return answer

    def stats(self, name: str) -> dict[str, Any]:
        """What the service says of the map."""
        answer = self.ask(keys.ask_key(name, "stats"))
        assert isinstance(answer, bytes), answer
        return codec.decode_map(answer)


@contextmanager
def bare(endpoint: str) -> Iterator[Bare]:
    """A session with the service at `endpoint`."""
    settings = zenoh.Config()
    for path, value in {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }.items():
        settings.insert_json5(path, json.dumps(value))
    with zenoh.open(settings) as session:
        yield Bare(session)


def keys_of(*names: str) -> np.ndarray:
    """Variable keys by how they print."""
    return np.array([parse_symbol(name) for name in names], np.int64)


def edge(i: str, j: str, x: float = 1.0) -> Factors:
    """A measurement of j in i's frame: x ahead and a slight turn."""
    return Factors("between_se2", keys_of(i, j)[None], np.array([[x, 0.0, 0.1]]), np.array([INFORMATION]))


def start(name: str = "x0") -> Batch:
    """The fixed first pose of a map."""
    return Batch((Variables("se2", keys_of(name), np.zeros((1, 3)), fixed=True),))


def pose(name: str, after: str, x: float = 1.0) -> Batch:
    """One more pose, and how it was reached."""
    return Batch((Variables("se2", keys_of(name)),), (edge(after, name, x),))
