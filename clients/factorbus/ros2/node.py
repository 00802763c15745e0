"""A ROS 2 node on a Zenoh session, as rmw_zenoh would have made it.  The only file here that touches zenoh."""

import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import zenoh
from zenoh.ext import HistoryConfig, declare_advanced_subscriber
from zenoh.handlers import Callback

from factorbus.client.link import open_session
from factorbus.proto import redact
from factorbus.proto.problems import Unavailable
from factorbus.ros2.names import NodeName, Topic, attachment, gid, read_attachment

_KEPT_S = 5.0  # for publishers to say what they have kept


class Node:
    """One node, seen by others from its token on.  Close it, or use it in `with`."""

    def __init__(self, session: zenoh.Session, domain: int, namespace: str, name: str) -> None:
        self._session, self._domain = session, domain
        self._name = NodeName(str(session.info.zid()), domain, namespace, name)
        self._tokens = [session.liveliness().declare_token(self._name.token())]
        self._declared: list[Any] = []

    def __enter__(self) -> "Node":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publisher(self, topic: Topic) -> "Publisher":
        """What publishes on a topic."""
        made = self._session.declare_publisher(
            topic.key(self._domain), congestion_control=zenoh.CongestionControl.DROP, express=True
        )
        self._declared.append(made)
        return Publisher(made, gid(self._announce("MP", topic)))

    def subscribe(self, topic: Topic, hear: Callable[[bytes], None], kept: bool = False) -> None:
        """From now on every message on a topic goes to `hear`, on Zenoh's thread: it may only hand over.

        kept: and those that its publishers have kept for who comes late (transient local).  Those of the publishers
        that are there already have gone to `hear` when this returns, unless one takes longer than `_KEPT_S` to answer.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            hear(sample.payload.to_bytes())

        key, handler = topic.key(self._domain), Callback(on_sample, indirect=False)
        if kept:
            history = HistoryConfig(detect_late_publishers=True, max_samples=topic.depth)
            self._declared.append(declare_advanced_subscriber(self._session, key, handler, history=history))
            self._wait_for_kept(key, topic.depth, hear)
        else:
            self._declared.append(self._session.declare_subscriber(key, handler))
        self._announce("MS", topic, kept)

    def _wait_for_kept(self, key: str, depth: int, hear: Callable[[bytes], None]) -> None:
        """Ask as the subscriber itself has asked, which does not say when it has been answered: what is published
        after this would be used without what was published long before it."""
        replies = self._session.get(
            f"{key}/@adv/**?_max={depth}",
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_KEPT_S,
        )
        for reply in replies:
            if reply.ok is not None:
                hear(reply.ok.payload.to_bytes())

    @property
    def full_name(self) -> str:
        """With its namespace."""
        return self._name.full_name

    def serve(self, topic: Topic, hear: Callable[["ServiceCall"], None]) -> None:
        """From now on every call of a service goes to `hear`, on Zenoh's thread: it may only hand over."""
        key = topic.key(self._domain)

        def on_query(query: zenoh.Query) -> None:
            hear(ServiceCall(query, key))

        handler = Callback(on_query, indirect=False)
        self._declared.append(self._session.declare_queryable(key, handler, complete=True))
        self._announce("SS", topic)

    def close(self) -> None:
        """Leave: tokens first, so that nobody counts on what is going."""
        for declared in (*self._tokens, *self._declared):
            declared.undeclare()
        self._tokens, self._declared = [], []
        self._session.close()

    def _announce(self, kind: str, topic: Topic, kept: bool = False) -> str:
        token = self._name.endpoint_token(len(self._tokens), kind, topic, kept)
        self._tokens.append(self._session.liveliness().declare_token(token))
        return token


class ServiceCall:
    """A call that waits for its answer, which has the number and the gid of the call, as rmw_zenoh's clients want."""

    def __init__(self, query: zenoh.Query, key: str) -> None:
        self._query, self._key = query, key
        self._number, self._gid = read_attachment(query.attachment.to_bytes() if query.attachment else b"")

    def reply(self, data: bytes) -> None:
        """CDR as it goes out; the caller waits no longer."""
        self._query.reply(self._key, data, attachment=attachment(self._number, time.time_ns(), self._gid))
        self._query.drop()


class Publisher:
    """Publishes on one topic, each message with its number and time.  May be used from several threads."""

    def __init__(self, publisher: zenoh.Publisher, of: bytes) -> None:
        self._publisher, self._gid, self._sequence, self._lock = publisher, of, 0, threading.Lock()

    def publish(self, data: bytes) -> None:
        """CDR as it goes out."""
        with self._lock:
            self._sequence += 1
            self._publisher.put(data, attachment=attachment(self._sequence, time.time_ns(), self._gid))


def open_node(
    endpoint: str, domain: int, namespace: str, name: str, timeout_s: float, settings: Mapping[str, Any], file: str = ""
) -> Node:
    """A node at the router (or whatever listens) at `endpoint`.  Raises Unavailable, BadEndpoint, BadSetting."""
    try:
        session = open_session([endpoint], timeout_s, settings, file)
    except Unavailable:
        hint = (
            "start ROS's router there with `ros2 run rmw_zenoh_cpp rmw_zenohd`, or leave --ros out where the robot's "
            "sessions connect to the service itself"
        )
        raise Unavailable(redact.endpoint(endpoint), timeout_s, hint) from None
    return Node(session, domain, namespace, name)
