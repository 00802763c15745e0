"""What a service with several cores makes of a map is, to the bit, what one core makes of it."""

import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from journalled import Services, Stream
from processes import PATIENCE_S

from factorbus.client import connect
from factorbus.journal.store import open_store
from factorbus.service.config import Limits
from factorbus.service.journal.library import make_map_solver
from factorbus.service.journal.recovery import verify
from factorbus.service.process.worker_threads import core_count
from factorbus.simulate import manhattan

POSES = 3000


@pytest.mark.timeout(300)
@pytest.mark.skipif(core_count() < 2, reason="there is one core for this process")
def test_what_was_made_on_several_cores_is_what_one_core_makes(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    batches = [step.batch for step in manhattan(POSES, 7)]
    running = services(tmp_path / "journal", "cores=2", "cores_from_bytes=0")
    with (
        connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        bus.map("m2", "bayes-tree", window=32) as map_,
    ):
        stream = Stream(map_, batches)
        stream.start()
        stream.allow(POSES)
        stream.join(PATIENCE_S)
        map_.flush(PATIENCE_S)
        (stats,) = bus.stats()
        assert stats["cores"]["used"] == 2
        assert stats["cores"]["pieces"] > 0
    running.end(signal.SIGTERM)
    store = open_store(tmp_path / "journal" / "m2", read_only=True)
    try:
        header = store.header()
        folder = make_map_solver(header.mode, header.options, header.epoch, Limits())
        assert all(same for _, same in verify(store, folder)), "here there is no worker thread"
    finally:
        store.close()
