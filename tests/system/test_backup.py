"""Backup and restore of deploy/README.md: all maps are copied while the service is at work, and put back elsewhere."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from journalled import Services, drafts
from processes import PATIENCE_S

from factorbus.client import connect

README = (Path(__file__).parents[2] / "deploy" / "README.md").read_text(encoding="utf-8")


def shell(line: str) -> tuple[int, str]:
    """Exit code and what was said, with our command for `factorbus`."""
    ours = f"{sys.executable} -m factorbus.cli"
    ran = subprocess.run(
        ["bash", "-c", re.sub(r"^factorbus", ours, line)],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    return ran.returncode, ran.stdout + ran.stderr


def test_all_maps_are_copied_at_work_and_restored(services: Callable[..., Services], tmp_path: Path) -> None:
    journal, other, backup = tmp_path / "journal", tmp_path / "other", tmp_path / "backup"
    copy, restore = re.findall(r"^factorbus (?:export --all|import) .*$", README, re.MULTILINE)
    copy = copy.replace("/var/lib/factorbus", str(journal)).replace("/backup", str(backup))
    restore = restore.replace("/var/lib/factorbus", str(other)).replace(
        "/backup/Monday", f"{backup}/{time.strftime('%A')}"
    )
    backup.mkdir()
    running, kept = services(journal), {}
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus:
        for name, count in (("hall", 30), ("yard", 20)):
            with bus.map(name, window=1) as joined:
                for batch in drafts(count):
                    joined.insert(batch)
                joined.wait_converged()
                kept[name] = joined.ask_estimate()
        code, said = shell(copy)
        assert code == 0, said
        copied = dict(re.findall(r"(\w+)\.fbmap: revision (\d+)", said))
        assert copied == {"m": "0"} | {name: str(estimate.revision) for name, estimate in kept.items()}, (
            "m: of the fixture"
        )
        with bus.map("yard") as yard:
            yard.insert(drafts(21)[-1])
            yard.wait_converged()
        assert shell(copy)[0] == 0, "a second time, in place of the first"
        with bus.map("yard") as yard:
            kept["yard"] = yard.ask_estimate()
    running.end(signal.SIGTERM)
    other.mkdir()
    code, said = shell(restore)
    assert code == 0, said
    restored = services(other)
    with connect(restored.start(), client="robot", timeout_s=PATIENCE_S) as bus:
        for name, before in kept.items():
            with bus.map(name) as joined:
                after = joined.ask_estimate()
                assert after.revision == before.revision
                for there, here in zip(before.variables, after.variables, strict=True):
                    assert np.array_equal(there.keys, here.keys)
                    assert there.values.tobytes() == here.values.tobytes()
        disk = bus.stats()[0]["disk"]
        assert 0 < disk["free_bytes"] <= disk["size_bytes"]


def test_a_map_that_cannot_be_read_is_said_and_the_others_are_copied(
    services: Callable[..., Services], tmp_path: Path
) -> None:
    journal, backup = tmp_path / "journal", tmp_path / "backup"
    running = services(journal)
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus:
        for name in ("first", "second", "third"):
            with bus.map(name) as joined:
                joined.insert(drafts(1)[0])
    running.end(signal.SIGTERM)
    (journal / "second" / "journal.db").write_bytes(b"nothing of SQLite's" * 100)
    backup.mkdir()
    (backup / "second.fbmap").write_text("the copy of a week before")
    code, said = shell(f"factorbus export --all --journal {journal} --out {backup}")
    assert (code, "not copied: second" in said) == (1, True), said
    assert sorted(path.name for path in backup.iterdir()) == ["first.fbmap", "m.fbmap", "second.fbmap", "third.fbmap"]
    assert (backup / "second.fbmap").read_text() == "the copy of a week before"


def test_one_map_or_all(tmp_path: Path) -> None:
    for words in ("", "hall --all"):
        code, said = shell(f"factorbus export {words} --journal {tmp_path}")
        assert (code, "name a MAP, or say --all" in said) == (2, True), said
    code, said = shell(f"factorbus export --all --journal {tmp_path / 'nowhere'}")
    assert code != 0
    assert "nowhere" in said
    code, said = shell(f"factorbus import a.fbmap b.fbmap --as hall --journal {tmp_path}")
    assert (code, "--as is for one FILE" in said) == (2, True), said
