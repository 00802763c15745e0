"""A robot's service and the one it is a replica of, with a link between them that a test cuts."""

import random
import threading
import time
from pathlib import Path
from typing import Any

from journalled import PATIENCE_S, Stream, check_journal, drafts, rows
from wire import Relay

from factorbus.client import connect
from factorbus.client.map import Map
from factorbus.journal.store import open_store

MAP = "m2"


class Link:
    """The relay between both, which is cut for a while now and then."""

    def __init__(self, upstream: str) -> None:
        self.relay = Relay(int(upstream.rpartition(":")[2]))
        self.endpoint = f"tcp/127.0.0.1:{self.relay.port}"

    def cut(self, seconds: float, noticed: bool) -> None:
        """Nothing passes for so long; then it does again, over a new connection where the cut is `noticed`."""
        self.relay.hold()
        time.sleep(seconds)  # the length of the cut is what a test asks for
        if noticed:
            self.relay.break_all()
        self.relay.release()

    def cut_often(self, cuts: int, seconds: tuple[float, float]) -> None:
        """Cuts, and as long as one lasts at least between them."""
        chance = random.Random(5)
        for n in range(cuts):
            self.cut(chance.uniform(*seconds), noticed=bool(n % 2))
            time.sleep(seconds[0])  # the link is whole for as long: what the drive is about


def replica_settings(link: Link, *more: str) -> tuple[str, ...]:
    """Of a service that follows what the link leads to."""
    return (f'upstream="{link.endpoint}"', 'name="robot1"', f'create=["{MAP}"]', *more)


def upstream_row(driven: Map) -> dict[str, Any]:
    """How a replica's map says that it follows."""
    return driven.stats().get("upstream", {"behind": -1, "connected": False})


def wait_until_level(driven: Map, at_base: Map, inserts: int, patience_s: float = PATIENCE_S) -> None:
    """Until both have the same, and nothing more is to come."""
    end = time.monotonic() + patience_s
    while True:
        row, here, there = upstream_row(driven), driven.stats(), at_base.stats()
        level = row["connected"] and row["behind"] == 0 and not here["converging"] and not there["converging"]
        journals = here["journal"], there["journal"]
        if level and journals[0]["records"] == journals[1]["records"]:
            found = sum(count for _, count in _counted(here))
            if found >= inserts:
                return
        assert time.monotonic() < end, (row, journals)
        time.sleep(0.1)  # stats tell nobody that they have changed


def _counted(stats: dict[str, Any]) -> list[tuple[str, int]]:
    return [(client, following - 1) for client, following in stats["clients"].items()]


def check_equal(base: Path, robot: Path, inserts: int) -> int:
    """Both journals have every insert once, and the same records, values included; gives the bytes of the inserts."""
    groups = [check_journal(folder / MAP, inserts) for folder in (base, robot)]
    assert groups[0] == groups[1]
    lasts, sizes = [], []
    for folder in (base, robot):
        store = open_store(folder / MAP, read_only=True)
        try:
            lasts.append(store.last())
            sizes.append(store.counts()["message_bytes"])
        finally:
            store.close()
    assert lasts[0] == lasts[1], "the chain is a digest of every value there ever was"
    return sizes[0]


def drive_with_cuts(
    robot: str, base: str, link: Link, poses: int, cuts: int, seconds: tuple[float, float], rate: float
) -> dict[str, float]:
    """`poses` inserted into the replica at a `rate` (1/s) while the link is cut; figures, once both are level.

    robot, base: endpoints.  seconds: how long a cut lasts, at least and at most.
    """
    batches = drafts(poses)
    with connect(robot, client="robot", timeout_s=PATIENCE_S) as bus, connect(base, timeout_s=PATIENCE_S) as other:
        driven = bus.map(MAP, window=32)
        stream = Stream(driven, batches)
        stream.start()
        cutting = threading.Thread(target=link.cut_often, args=(cuts, seconds))
        cutting.start()
        for n in range(poses):
            stream.allow(1)
            stream.wait_for(n + 1)  # also while the link is cut
            time.sleep(1 / rate)  # a robot drives
        cutting.join()
        stream.wait_for(poses)
        assert not stream.fault
        at_base = other.map(MAP)
        wait_until_level(driven, at_base, poses, 10 * PATIENCE_S)
        estimates = [each.ask_estimate() for each in (driven, at_base)]
        assert estimates[0].revision == estimates[1].revision
        assert rows(estimates[0].variables) == rows(estimates[1].variables)
        row = upstream_row(driven)
        return {"rebased": row["rebased"], "carried_bytes": link.relay.carried_bytes, "same_bits": row["same_bits"]}
