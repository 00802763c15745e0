"""A service whose map was ordered anew beside its steps has the same map, to the bit, after it was killed."""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from journalled import Services, Stream, rows
from processes import PATIENCE_S

from factorbus.client import connect
from factorbus.journal.store import open_store
from factorbus.service.config import Limits
from factorbus.service.journal.library import make_folder
from factorbus.service.journal.recovery import verify
from factorbus.simulate import manhattan

POSES = 1600


@pytest.mark.timeout(600)
@pytest.mark.parametrize("durability", ["commit", "none"])
def test_killed_after_another_solver_took_the_place_it_comes_back_as_it_was(
    services: Callable[..., Services], tmp_path: Path, durability: str
) -> None:
    """R has more than a hundredth of the numbers of a fresh order, so it is done at the first look."""
    batches = [step.batch for step in manhattan(POSES, 5)]
    running = services(tmp_path / "journal", "reorder=0.01", "snapshot_s=0.02", f'durability="{durability}"')
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", "bayes-tree", window=32) as driven,
    ):
        stream = Stream(driven, batches)
        stream.start()
        sent = 0
        while not driven.stats()["strategies"].get("full"):
            assert sent < POSES, "nothing took the place"
            stream.allow(20)
            sent += 20
            stream.wait_for(sent)
        stream.allow(20)  # and goes on from there
        stream.wait_for(sent + 20)
        stream.stop.set()
        stream.allow(1)
        stream.join(PATIENCE_S)
        driven.wait_converged(PATIENCE_S)
        estimate, mirrored = driven.ask_estimate(), driven.estimate.columns("se2")
        assert {key: value for key, (value, _) in rows(estimate.variables).items()} == {
            int(key): row.tobytes() for key, row in zip(mirrored[0], mirrored[1], strict=True)
        }
        running.end(signal.SIGTERM if durability == "none" else signal.SIGKILL)
        running.start()
        again = driven.ask_estimate()
        assert again.revision == estimate.revision
        assert rows(again.variables) == rows(estimate.variables)
    running.end(signal.SIGTERM)
    store = open_store(tmp_path / "journal" / "m2", read_only=True)
    try:
        assert len(store.reordered()) >= 1
        header = store.header()
        folder = make_folder(header.mode, header.options, header.epoch, Limits())
        assert all(same for _, same in verify(store, folder)), "from the first insert on, too"
    finally:
        store.close()
