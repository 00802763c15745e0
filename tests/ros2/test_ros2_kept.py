"""What publishers have kept for late subscribers is heard before anything that comes later."""

import json
import time
from collections.abc import Iterator

import pytest
import ros
import survey
import words
import zenoh
from browser import free_port

from factorbus.ros2.messages import TRANSFORMS, Messages
from factorbus.ros2.names import Topic
from factorbus.ros2.node import open_node

TOPIC = Topic("/tf_static", TRANSFORMS, Messages("jazzy").hash(TRANSFORMS), 100)


@pytest.fixture
def at() -> Iterator[str]:
    """Where a router listens."""
    endpoint, config = f"tcp/127.0.0.1:{free_port()}", zenoh.Config()
    for path, value in {"mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False}.items():
        config.insert_json5(path, json.dumps(value))
    with zenoh.open(config):
        yield endpoint


def test_what_was_kept_has_been_heard_when_the_subscription_is_made(at: str) -> None:
    static, *_ = survey.said(survey.survey())
    with ros.session(at) as robot, ros.session(at) as other:
        latching = ros.RosNode(robot, 5)  # it publishes for as long as it is there
        latching.latch("/tf_static", static.message)
        kept = f"{ros.topic_key(5, '/tf_static', words.TFMessage)}/@adv/**"
        end = time.monotonic() + 60
        while not [reply for reply in other.get(kept, accept_replies=zenoh.ReplyKeyExpr.ANY) if reply.ok is not None]:
            assert time.monotonic() < end, "the router never knew of it"
        for _ in range(5):
            with open_node(at, 5, "%", "late", 10.0, {}) as node:
                heard = list[bytes]()
                node.subscribe(TOPIC, heard.append, kept=True)
                assert set(heard) == {bytes(static.message.serialize())}


def test_nobody_who_has_kept_anything_is_waited_for(at: str) -> None:
    with open_node(at, 5, "%", "first", 10.0, {}) as node:
        heard = list[bytes]()
        node.subscribe(TOPIC, heard.append, kept=True)
        assert heard == []
