"""The runbook of deploy/README.md with journals: a map moves between two services at a router, both at work."""

import contextlib
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from journalled import Services, drafts
from processes import PATIENCE_S, Process

from factorbus.client import connect
from factorbus.proto.problems import Unavailable

ROUTER = str(Path(__file__).parent / "router.py")
COUNT = 120


def factorbus(*words: str) -> tuple[int, str]:
    """Its exit code, and what it said."""
    ran = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *words], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    return ran.returncode, ran.stdout + ran.stderr


def test_export_import_drop_while_somebody_inserts(
    services: Callable[..., Services], spawn: Callable[..., Process], tmp_path: Path
) -> None:
    (router,) = spawn(ROUTER, "tcp/127.0.0.1:0").ready()
    journals, batches = [tmp_path / "0", tmp_path / "1"], drafts(COUNT + 2)
    for n, journal in enumerate(journals):
        at_router = (f'connect=["{router}"]', 'mode="client"', f'maps="shard{n}-*"', f'create=["shard{n}-m"]')
        services(journal, *at_router).start()
    file = str(tmp_path / "hall.fbmap")

    def export() -> int:
        code, said = factorbus("export", "shard0-hall", "--journal", str(journals[0]), "--out", file)
        assert code == 0, said
        return int(re.findall(r"revision (\d+)", said)[0])

    def drop(name: str, *more: str) -> tuple[int, str]:
        return factorbus("drop", name, *more, "--connect", router)

    with connect(router, client="robot", timeout_s=PATIENCE_S) as bus:
        with bus.map("shard0-hall", "inc-l", window=1) as hall:
            for batch in batches[:COUNT]:
                hall.insert(batch)
            hall.wait_converged()
            copied = export()
            hall.insert(batches[COUNT])  # behind the operator's back
            assert factorbus("import", file, "--journal", str(journals[1]), "--as", "shard1-hall")[0] == 0
            code, said = drop("shard0-hall", "--revision", str(copied))
            assert (code, bool(re.search(rf"at revision \d+, not at {copied}", said))) == (5, True), said
            assert hall.insert(batches[COUNT + 1]).revision >= copied + 2, "it is there, and takes inserts"
            hall.wait_converged()
            before = hall.ask_estimate()
        assert bus.create("shard1-hall", "inc-l").revision == copied
        assert drop("shard1-hall")[0] == 0, "the copy that came too early"

        copied = export()
        assert factorbus("import", file, "--journal", str(journals[1]), "--as", "shard1-hall")[0] == 0
        assert drop("shard0-hall", "--revision", str(copied))[0] == 0
        assert not (journals[0] / "shard0-hall").exists()
        with pytest.raises(Unavailable):  # at a router nobody says that nobody has it
            bus.drop("shard0-hall", timeout_s=0.5)
        with bus.map("shard1-hall", "inc-l") as moved:
            after = moved.ask_estimate()
            assert (after.revision, moved.epoch) == (before.revision, before.epoch)
            for there, here in zip(before.variables, after.variables, strict=True):
                assert np.array_equal(there.keys, here.keys)
                assert there.values.tobytes() == here.values.tobytes()
            assert moved.insert(drafts(COUNT + 3)[-1]).revision == copied + 1
            moved.wait_converged()
            copied = moved.estimate.revision - 1
    code, said = factorbus("journal", "verify", "shard1-hall", "--journal", str(journals[1]))
    assert (code, f"{copied + 1} revisions, all the same to the bit" in said) == (0, True), said


def test_verify_says_from_where_on_a_journal_gives_something_else(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    journal, running = tmp_path / "journal", services(tmp_path / "journal")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("hall", window=1) as hall:
        for batch in drafts(60):
            hall.insert(batch)
    running.end(signal.SIGTERM)
    assert factorbus("journal", "verify", "hall", "--journal", str(journal))[0] == 0
    for change, code, words in (
        ("UPDATE record SET chain = zeroblob(16) WHERE number = 40", 1, "values differ from revision 40 on (of 60)"),
        ("UPDATE record SET revision = revision + 1 WHERE number = 40", 5, "led to revision 41, and leads to 40"),
        ("UPDATE entry SET message = zeroblob(9) WHERE number = 40", 5, "is not what was written"),
    ):
        shutil.copytree(journal, tmp_path / "changed")
        with contextlib.closing(sqlite3.connect(tmp_path / "changed" / "hall" / "journal.db")) as database:
            database.execute(change)
            database.commit()
        seen, said = factorbus("journal", "verify", "hall", "--journal", str(tmp_path / "changed"))
        assert (seen, words in said) == (code, True), said
        shutil.rmtree(tmp_path / "changed")
