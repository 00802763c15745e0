"""Python's state of a thread of Zenoh: dropped after every callback, unless it is kept."""

import json
import queue
import threading
from collections.abc import Callable
from contextlib import suppress

import pytest
import zenoh
from zenoh.handlers import Callback

from factorbus.proto.kept_state import keep_state

MESSAGES = 12  # more than Zenoh has threads that receive


def opened(**settings: object) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in ({"scouting/multicast/enabled": False} | settings).items():
        config.insert_json5(path.replace("__", "/"), json.dumps(value))
    return zenoh.open(config)


def came_of(came: queue.SimpleQueue, sender: zenoh.Session) -> tuple[int, bool]:
    """What a message came to; the first may be sent before it is known who listens."""
    for _ in range(300):
        sender.put("kept", b"")
        with suppress(queue.Empty):
            return came.get(timeout=0.1)
    raise TimeoutError("no message came in 30 s")


@pytest.mark.parametrize(("first", "found"), [(keep_state, True), (lambda: None, False)])
def test_what_belongs_to_a_thread_is_there_at_its_next_callback(first: Callable[[], None], found: bool) -> None:
    here, came = threading.local(), queue.SimpleQueue()

    def on_sample(_: zenoh.Sample) -> None:
        first()
        came.put((threading.get_ident(), hasattr(here, "seen")))
        here.seen = True

    with opened(mode="peer", listen__endpoints=["tcp/127.0.0.1:0"], adminspace__enabled=True) as hub:
        (reply,) = [r for r in hub.get(f"@/{hub.info.zid()}/*") if r.ok is not None]
        assert reply.ok is not None
        (endpoint,) = json.loads(reply.ok.payload.to_bytes())["locators"]
        hub.declare_subscriber("kept", Callback(on_sample, indirect=False))
        with opened(mode="client", connect__endpoints=[endpoint]) as other:
            heard = [came_of(came, other) for _ in range(MESSAGES)]
    threads: set[int] = set()
    for thread, seen in heard:
        assert thread != threading.get_ident()
        assert seen == (found and thread in threads)
        threads.add(thread)
