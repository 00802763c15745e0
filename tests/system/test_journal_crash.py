"""A service that is killed again and again loses nothing it has answered, and does nothing twice.

FACTORBUS_KILLS says how often it is killed (`make crash`: more than a hundred times); here fewer, to save time.
"""

import os
import random
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from journalled import Services, Stream, check_journal, drafts, rows, uninterrupted
from processes import PATIENCE_S

from factorbus.client import connect
from factorbus.proto.messages import Estimate

KILLS = int(os.environ.get("FACTORBUS_KILLS", "12"))
EACH = 120  # inserts let loose before a kill


@pytest.mark.timeout(1200)
@pytest.mark.parametrize(
    ("mode", "window", "kills"), [("inc-l", 32, KILLS), ("bayes-tree", 32, KILLS // 3), ("inc-l", 1, 4)]
)
def test_killed_at_any_moment_nothing_answered_is_lost_and_nothing_is_done_twice(
    services: Callable[..., Services], tmp_path: Path, mode: str, window: int, kills: int
) -> None:
    chance, batches, back_s = random.Random(kills), drafts(EACH * kills + 1), list[float]()
    running = services(tmp_path / "journal", "checkpoint_s=0.15")
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", mode, window=window) as driven,
    ):
        stream = Stream(driven, batches)
        stream.start()
        for kill in range(kills):
            stream.allow(EACH)
            time.sleep(chance.uniform(0.0, 0.25))  # the moments are what this is about
            running.end(signal.SIGKILL)
            answered = set(stream.acknowledged)
            if kill % 4 == 0:
                tear_last_page(tmp_path / "journal" / "m2", chance)
            if kill % 5 == 4:
                running.bear()  # and killed while it starts, reads its journal, or is just ready
                time.sleep(chance.uniform(0.0, 0.3))
                running.end(signal.SIGKILL)
            begun = time.monotonic()
            running.start()
            back_s.append(time.monotonic() - begun)
            there = {int(key) for group in driven.ask_estimate().variables for key in group.keys}
            wanted = {int(k) for n in answered for g in batches[n - 1].variables for k in g.keys}
            assert wanted <= there, f"kill {kill}: {len(wanted - there)} answered inserts are gone"
        stream.stop.set()
        stream.allow(1)
        stream.join(PATIENCE_S)
        driven.wait_converged(PATIENCE_S)
        assert not stream.fault
        assert stream.acknowledged == {pending_insert.sequence for pending_insert in stream.pending_inserts}
        sent, estimate = len(stream.pending_inserts), driven.ask_estimate()
        stats = driven.stats()
        assert stats["epoch"] == driven.epoch, "the map is the one that was joined"
        assert stats["variables"] == sent
        assert stats["factors"] == sum(batch.factor_count for batch in batches[:sent])
        mirrored = tuple(column.tobytes() for column in driven.estimate.columns("se2"))
    running.end(signal.SIGTERM)
    groups = check_journal(tmp_path / "journal" / "m2", sent)
    whole = uninterrupted(mode, batches, groups)
    assert rows(estimate.variables) == whole, "to the bit what a run without interruption gives"
    print(
        f"{mode}, window {window}: {kills} kills and {kills // 5} while it started; {sent} inserts, each there once, "
        f"in {len(groups)} records; ready again after {np.median(back_s):.2f} s, at most {max(back_s):.2f} s"
    )
    assert mirrored == sorted_columns(estimate)


def tear_last_page(folder: Path, chance: random.Random) -> None:
    """What a write leaves behind that was under way when the power went: a part of it, and nonsense."""
    with (folder / "journal.db-wal").open("ab") as log:
        log.write(chance.randbytes(chance.randrange(1, 4096)))


def sorted_columns(estimate: Estimate) -> tuple[bytes, bytes]:
    keys = np.concatenate([group.keys for group in estimate.variables])
    values = np.concatenate([group.values for group in estimate.variables if group.values is not None])
    order = np.argsort(keys)
    return keys[order].tobytes(), values[order].tobytes()
