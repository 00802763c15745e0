"""A service that stands by takes over from one that is killed: with everything, while clients stream."""

import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from journalled import Services, Stream, check_journal, drafts, rows, uninterrupted
from processes import PATIENCE_S, Process

from factorbus.client import connect

TAKEOVERS = 6
EACH = 150
ROUTER = str(Path(__file__).parent / "router.py")


@pytest.mark.parametrize("hub", ["itself", "router"])
def test_it_takes_over_while_a_client_streams(
    services: Callable[..., Services], spawn: Callable[..., Process], tmp_path: Path, hub: str
) -> None:
    folder, settings, endpoint = tmp_path / "journal", [], "tcp/127.0.0.1:0"
    if hub == "router":
        (endpoint,) = spawn(ROUTER, endpoint).ready()
        settings = ['mode="client"', f'connect=["{endpoint}"]']
    first, *others = (services(folder, *settings, *extra) for extra in ((), ("standby=true",), ("standby=true",)))
    first.bear(endpoint)
    endpoint = first.ready()
    second = others[0]
    second.bear(endpoint)
    chance, batches = random.Random(3), drafts(EACH * (TAKEOVERS + 1))
    owner, waiting, times = first, second, []
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m2", "inc-l", window=32) as driven:
        stream = Stream(driven, batches)
        stream.start()
        for takeover in range(TAKEOVERS):
            stream.allow(EACH)
            stream.wait_for(EACH * takeover + chance.randrange(EACH))
            before, killed = len(stream.acknowledged), time.monotonic()
            owner.end(signal.SIGKILL)
            waiting.ready()
            stream.wait_for(min(before + 33, EACH * (takeover + 1)))  # more than can have been on its way
            times.append(time.monotonic() - killed)
            owner, waiting = waiting, next(each for each in others if each is not waiting)
            waiting.bear(endpoint)
        stream.allow(EACH)
        stream.wait_for(len(batches))
        assert not stream.fault
        driven.wait_converged(PATIENCE_S)
        estimate = driven.ask_estimate()
        assert estimate.epoch == driven.epoch, "it is the same map"
    print(f"{hub}: answered again {min(times):.2f} to {max(times):.2f} s after the kill of its owner")
    waiting.end(signal.SIGKILL)
    owner.end(signal.SIGTERM)
    groups = check_journal(folder / "m2", len(batches))
    assert rows(estimate.variables) == uninterrupted("inc-l", batches, groups)


def test_a_second_service_refuses_and_one_that_stands_by_can_be_told_to_stop(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    owner, other = services(tmp_path / "journal"), services(tmp_path / "journal")
    owner.start()
    other.bear("tcp/127.0.0.1:0")
    assert other.refused() == "journal_in_use"
    waiting = services(tmp_path / "journal", "standby=true")
    waiting.bear("tcp/127.0.0.1:0")
    waiting.end(signal.SIGTERM)
    owner.end(signal.SIGTERM)
    other.start()
