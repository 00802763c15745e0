"""A service that fails in every way the bus allows, over real zenoh on a local socket: the client is tried against it.

It is small (it stores point2 values as they come) but keeps the contract of `proto/README.md`: epochs, numbering, first
answers repeated, deltas with their previous revision.  What it does wrong, it is told to.
"""

import json
import threading
from collections import Counter, deque
from collections.abc import Callable, Iterable
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import zenoh
from zenoh.handlers import Callback

from factorbus.client import Draft
from factorbus.client.mirror import Mirror
from factorbus.proto import codec, keys
from factorbus.proto.messages import Accepted, Batch, Delta, Estimate, Variables
from factorbus.proto.problems import BadSequence, Busy, Problem, UnknownMap, WrongEpoch

MAP = "kitchen"


class Service:
    """One map, owned as the contract says; `faults` are taken one per insert.

    endpoint: where it listens; absent: at the socket in `folder`.
    """

    def __init__(self, folder: Path, epoch: int = 1, endpoint: str | None = None) -> None:
        self.epoch, self.revision = epoch, 0
        self.values: dict[int, np.ndarray] = {}
        self.answers: dict[tuple[str, int], bytes] = {}
        self.next: Counter[str] = Counter()
        self.faults: deque[str] = deque()
        self.tries: Counter[int] = Counter()
        self.asked: list[str] = []
        self.mute = False
        self.ask_fault = ""
        self.before_estimate: Callable[[], None] | None = None  # called once, before the estimate is answered
        self.report: dict[str, Any] = {}  # of every step
        self.says: dict[str, Any] = {}  # of the map, besides its row
        self.held: list[zenoh.Query] = []
        self._inbox: SimpleQueue[zenoh.Query | None] = SimpleQueue()
        self._session = zenoh.open(peer(endpoint or endpoint_in(folder)))
        self._queryables = [
            self._session.declare_queryable(key, Callback(self._inbox.put, indirect=False), complete=True)
            for key in (keys.inserts_of_any_client(MAP), f"{keys.PREFIX}/map/*/ask/*", f"{keys.PREFIX}/admin/*")
        ]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        self._token = self._session.liveliness().declare_token(keys.service_token(MAP, f"s{epoch}"))

    def close(self) -> None:
        self._inbox.put(None)
        self._thread.join(5)
        for query in self.held:
            query.drop()
        self._session.close()

    def step(self, values: dict[int, tuple[float, float]]) -> None:
        """A step that no insert of ours caused."""
        self.values |= {key: np.array(value, float) for key, value in values.items()}
        self.revision += 1
        if not self.mute:
            self.publish_last(values)

    def publish_last(self, changed: Iterable[int]) -> None:
        """The delta of the last step, which changed these."""
        delta = Delta(self.epoch, self.revision, self.revision - 1, self._columns(list(changed)), self.report)
        self.publish_raw(codec.encode_delta(delta))

    def publish_raw(self, data: bytes) -> None:
        """Something on the delta's key, a delta or not."""
        self._session.put(keys.delta_key(MAP), data, congestion_control=zenoh.CongestionControl.BLOCK)

    def _run(self) -> None:
        while (query := self._inbox.get()) is not None:
            key = str(query.key_expr)
            payload = query.payload.to_bytes() if query.payload else b""
            try:
                if "/in/" in key:
                    answer = self._insert(keys.client_of(key), codec.decode_insert(payload), query)
                elif "/ask/" in key:
                    if key != keys.ask_key(MAP, key.rpartition("/")[2]):
                        raise UnknownMap(key.split("/")[3])
                    answer = self.answered(key.rpartition("/")[2], payload)
                else:
                    answer = self._admin(key.rpartition("/")[2])
                if answer is not None:
                    query.reply(query.key_expr, answer)
            except Problem as problem:
                query.reply_err(codec.encode_problem(problem))
            if query not in self.held:
                query.drop()

    def _insert(self, client: str, insert: Any, query: zenoh.Query) -> bytes | None:
        self.tries[insert.sequence] += 1
        fault = self.faults.popleft() if self.faults else ""
        if fault == "silence":
            return None
        if fault == "busy":
            raise Busy(1, 0.01)
        if fault == "hold":
            self.held.append(query)
            return None
        if insert.epoch not in (0, self.epoch):
            raise WrongEpoch(insert.epoch, self.epoch)
        if fault == "parked too long":
            raise BadSequence(client, insert.sequence, "earlier", insert.sequence - 1)
        if (client, insert.sequence) not in self.answers:
            if insert.sequence != self.next[client] + 1:
                raise BadSequence(client, insert.sequence, "the next", self.next[client] + 1)
            self.next[client] += 1
            self.answers[client, insert.sequence] = self._apply(insert)
        if fault == "answer lost":
            return None
        answer = self.answers[client, insert.sequence]
        if not answer:
            raise Problem("there is a NaN in it")
        return answer

    def _apply(self, insert: Any) -> bytes:
        groups = insert.batch.variables
        if any(not np.isfinite(group.values).all() for group in groups):
            return b""
        self.step({int(k): tuple(v) for g in groups for k, v in zip(g.keys, g.values, strict=True)})
        return codec.encode_accepted(Accepted(insert.sequence, self.epoch, self.revision, 0, 1, {}))

    def answered(self, question: str, payload: bytes) -> bytes | None:
        self.asked.append(question)
        if self.ask_fault == "silence":
            return None
        if question == "stats":
            return codec.encode_map(self.row())
        if self.before_estimate is not None:
            first, self.before_estimate = self.before_estimate, None
            first()
        wanted = codec.decode_keys_asked(payload)
        chosen = list(self.values) if wanted is None else wanted.tolist()
        return codec.encode_estimate(Estimate(self.epoch, self.revision, self._columns(chosen)))

    def _admin(self, operation: str) -> bytes:
        row = self.row()
        return codec.encode_map({"maps": [row]} if operation == "maps" else row)

    def row(self) -> dict[str, Any]:
        row = {"name": MAP, "mode": "auto", "epoch": self.epoch, "revision": self.revision}
        return row | {"variables": len(self.values), "factors": 0} | self.says

    def _columns(self, chosen: list[int]) -> tuple[Variables, ...]:
        if not chosen:
            return ()
        return (Variables("point2", np.array(chosen), np.array([self.values[key] for key in chosen])),)


def endpoint_in(folder: Path) -> str:
    return f"unixsock-stream/{folder}/bus.sock"


def peer(endpoint: str) -> zenoh.Config:
    """Of a session that listens there, and nowhere else."""
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


def point(key: str, x: float, y: float = 0.0) -> Draft:
    return Draft().point2(key, (x, y))


def not_a_number(key: str) -> Batch:
    """A point that the service refuses; a draft would, before it is sent."""
    drafted = point(key, 0.0).batch()
    return Batch(tuple(group._replace(values=np.full((1, 2), np.nan)) for group in drafted.variables))


def same(mirror: Mirror, service: Service) -> bool:
    numbers, values = mirror.columns("point2")
    return {k: v.tobytes() for k, v in zip(numbers.tolist(), values, strict=True)} == {
        k: v.tobytes() for k, v in service.values.items()
    }
