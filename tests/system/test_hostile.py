"""What a stuck or hostile client costs the others: an honest one drives on while it is there."""

import socket
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from bare import bare
from processes import PATIENCE_S, Process, within_patience

from factorbus.client import Draft, connect
from factorbus.client.map import Map

# Floods as fast as the machine can keep up, which tests beside them would pay for.
pytestmark = pytest.mark.alone

Spawn = Callable[..., Process]
HOSTILE = str(Path(__file__).parent / "hostile.py")
# Many enough that the patience ends before they have come if each takes a second, which is what one full queue to
# somebody who does not read costs every client that shares a thread with it.
INSERTS = 2 * int(PATIENCE_S)


@pytest.fixture
def service(tmp_path: Path, spawn: Spawn) -> str:
    settings = tmp_path / "serve.toml"
    # No front end here inserts 20,000 poses at once, so none may: who may has the solver for as long as that takes.
    # A flood of questions is refused but for a few, and the flooding client does not take these refusals either.
    settings.write_text("[limits]\nsessions = 200\ninsert_variables = 1000\nquestions = 4\n")
    process = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings))
    return process.ready()[0]


def times(driven: Map, first: int, count: int = INSERTS) -> list[float]:
    """Seconds from sending to answer."""
    seconds = []
    for n in range(first, first + count):
        draft = Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0.1), sigmas=(0.1, 0.1, 0.02))
        begun = time.perf_counter()
        assert driven.insert(draft, timeout_s=60).sequence == n + 1
        seconds.append(time.perf_counter() - begun)
        time.sleep(0.005)  # a robot that inserts at a pace, not as fast as it can
    return seconds


@pytest.mark.parametrize("way", ["garbage", "unread", "questions", "large", "names", "window"])
def test_it_costs_the_others_nothing(service: str, spawn: Spawn, way: str) -> None:
    with connect(service, client="honest", timeout_s=60) as bus, bus.map("shared", mirror=False) as driven:
        driven.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        times(driven, 1, 30)
        before = within_patience(lambda: times(driven, 31))
        hostile = spawn(HOSTILE, service, "shared", way)
        hostile.ready()
        during = within_patience(lambda: times(driven, 31 + INSERTS))
        hostile.tell("stop")
        sent = int(hostile.line("sent")[0])
        for name, each in (("before", before), ("during", during)):
            print(f"{way}, {name}: {1e3 * statistics.median(each):.2f} ms median, {1e3 * max(each):.2f} ms at most")
        assert sent > 50, "it was hostile"


def test_connections_that_say_nothing_do_not_keep_others_out(service: str) -> None:
    host, port = service.partition("/")[2].split(":")
    silent = [socket.create_connection((host, int(port)), timeout=60) for _ in range(150)]
    try:
        # Half of what it takes where Zenoh's own limits let a hundred of them keep the others out.
        with connect(service, client="late", timeout_s=60) as bus:
            bus.maps()
    finally:
        for each in silent:
            each.close()


def test_more_sessions_than_allowed_are_turned_away_and_those_inside_go_on(tmp_path: Path, spawn: Spawn) -> None:
    settings = tmp_path / "few.toml"
    settings.write_text("[limits]\nsessions = 3\n")
    endpoint = spawn(
        "-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--no-warm", "--config", str(settings)
    ).ready()[0]
    with bare(endpoint) as first, bare(endpoint) as second, bare(endpoint):
        with pytest.raises(Exception, match="did not answer"), connect(endpoint, timeout_s=0.3):
            pass
        first.create("kitchen")
        assert second.stats("kitchen")["revision"] == 0
