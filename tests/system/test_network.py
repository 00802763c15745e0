"""A network that loses, delays and cuts: client and service come back by themselves, nothing is lost, nothing twice."""

import hashlib
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from journalled import check_journal, drafts, uninterrupted
from processes import Process
from wire import SERVICE, Relay, Wire

STREAMER = str(Path(__file__).parent.parent / "streamer.py")
COUNT = 900
PARTITION_S = 10.0


@pytest.fixture
def wire() -> Iterator[Wire]:
    made = Wire()
    yield made
    made.close()


def serve(spawn: Callable[..., Process], endpoint: str, journal: Path, *before: str) -> Process:
    options = ("--listen", endpoint, "--journal", str(journal), "--insecure")
    return spawn(*before, "-m", "factorbus.service", *options)


def check(journal: Path, done: list[str]) -> None:
    """Every insert is there once, in order; the client's mirror has what the solver would have without faults."""
    batches = drafts(COUNT)
    whole = uninterrupted("inc-l", batches, check_journal(journal / "m2", COUNT))
    content = hashlib.sha256()
    order = sorted(whole)
    content.update(np.array(order, np.int64).tobytes() + b"".join(whole[key][0] for key in order))
    assert done[1] == content.hexdigest()


def test_loss_delay_and_a_partition_between_two_namespaces(
    spawn: Callable[..., Process], tmp_path: Path, wire: Wire
) -> None:
    service = serve(spawn, f"tcp/{SERVICE}:7447", tmp_path / "journal", *wire.run("service"))
    service.ready()
    client = spawn(*wire.run("client"), STREAMER, f"tcp/{SERVICE}:7447", "m2", str(COUNT))
    client.line("ready")
    told: dict[str, str] = {}

    def more(count: int, what: str) -> None:
        client.tell(f"more {count}")
        told[what] = client.line("answered")[1]

    more(200, "clean")
    wire.loss, wire.delay_s, wire.jitter_s = 0.05, 0.01, 0.02
    more(200, "5 % lost, 10 to 30 ms late")
    assert wire.dropped > 5
    wire.loss = wire.delay_s = wire.jitter_s = 0.0
    client.tell("more 300")
    wire.cut = True
    time.sleep(PARTITION_S)  # what this is about
    wire.cut, mended = False, time.monotonic()
    told["in the partition"] = client.line("answered")[1]
    back_s = time.monotonic() - mended
    more(200, "clean again")
    client.tell("end")
    done = client.line("done")
    print(f"{told}; back {back_s:.2f} s after the partition; {wire.dropped} packets lost, {wire.carried} carried")
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    check(tmp_path / "journal", done)


def test_connections_that_hang_and_break(spawn: Callable[..., Process], tmp_path: Path) -> None:
    service = serve(spawn, "tcp/127.0.0.1:0", tmp_path / "journal")
    relay = Relay(int(service.ready()[0].rpartition(":")[2]))
    try:
        endpoint = f"tcp/127.0.0.1:{relay.port}"
        client = spawn(STREAMER, endpoint, "m2", str(COUNT))
        client.line("ready")
        relay.delay_s = 0.005
        client.tell("more 200")
        client.line("answered")
        for turn in range(4):
            client.tell("more 150")
            relay.hold()
            time.sleep(1.0 + 1.2 * turn)  # shorter and longer than the lease, after which both sides give up
            if turn % 2:
                relay.break_all()
            relay.release()
            client.line("answered")
        relay.delay_s = 0.0
        client.tell("more 100")
        client.line("answered")
        client.tell("end")
        done = client.line("done")
    finally:
        relay.close()
    service.signal(signal.SIGTERM)
    assert service.wait() == 0
    check(tmp_path / "journal", done)
