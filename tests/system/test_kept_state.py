"""Python's state of a thread of Zenoh: dropped after every callback, unless it is kept.

In a process of its own: a thread whose state is kept keeps it, whoever asks next.
"""

import json
import queue
import subprocess
import sys
import threading
from contextlib import suppress

import pytest
import zenoh
from zenoh.handlers import Callback

from factorbus.proto.kept_state import keep_state

MESSAGES = 12  # more than Zenoh has threads that receive


@pytest.mark.parametrize("kept", [True, False])
def test_what_belongs_to_a_thread_is_there_at_its_next_callback(kept: bool) -> None:
    command = [sys.executable, __file__, *(["keep"] if kept else [])]
    heard = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=60).stdout)
    assert len(heard) == MESSAGES
    threads: set[int] = set()
    for thread, seen in heard:
        assert seen == (kept and thread in threads)
        threads.add(thread)


def hear(keep: bool) -> list[tuple[int, bool]]:
    """For every message its thread, and whether that still has what it was given at the message before."""
    here, came = threading.local(), queue.SimpleQueue()

    def on_sample(_: zenoh.Sample) -> None:
        if keep:
            keep_state()
        came.put((threading.get_ident(), hasattr(here, "seen")))
        here.seen = True

    settings = {"listen/endpoints": ["tcp/127.0.0.1:0"], "adminspace/enabled": True}
    with opened("peer", settings) as hub:
        (reply,) = [r for r in hub.get(f"@/{hub.info.zid()}/*") if r.ok is not None]
        assert reply.ok is not None
        endpoints = json.loads(reply.ok.payload.to_bytes())["locators"]
        hub.declare_subscriber("kept", Callback(on_sample, indirect=False))
        with opened("client", {"connect/endpoints": endpoints}) as sender:
            return [heard(came, sender) for _ in range(MESSAGES)]


def heard(came: queue.SimpleQueue, sender: zenoh.Session) -> tuple[int, bool]:
    """What a message came to; the first may be sent before it is known who listens."""
    for _ in range(300):
        sender.put("kept", b"")
        with suppress(queue.Empty):
            return came.get(timeout=0.1)
    raise TimeoutError("no message came in 30 s")


def opened(mode: str, settings: dict[str, object]) -> zenoh.Session:
    config = zenoh.Config()
    for path, value in {"mode": mode, "scouting/multicast/enabled": False, **settings}.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


if __name__ == "__main__":
    print(json.dumps(hear("keep" in sys.argv)))
