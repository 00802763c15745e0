"""Two processes that copy one map at a time, out of a journal or into a folder of journals."""

import subprocess
import sys
from pathlib import Path

import pytest

from factorbus.journal import bundle
from factorbus.journal.bundle import export_map, import_map
from factorbus.journal.digest import sealed
from factorbus.journal.problems import MapThere
from factorbus.journal.records import ACCEPTED, Entry, JournalRecord
from factorbus.journal.store import Store, create, open_store

ENTRY = sealed(Entry("a", 1, 0, ACCEPTED, 1, 10, 1, b"", b"hello"))


def test_who_imports_or_exports_the_same_in_another_process_is_not_disturbed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other one is faster; and what a process that is gone had begun is removed."""
    store = create(tmp_path / "m", "m", "inc-l", {"mode": "inc-l"}, 77, "commit")
    store.append([JournalRecord(1, 1, False, bytes(16), (ENTRY,))])
    file, to = tmp_path / "m.fbmap", tmp_path / "other" / "n"
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (tmp_path / f".m.fbmap.{gone.pid}.part").write_bytes(b"half")
    (tmp_path / ".m.fbmap.1.part").write_bytes(b"of a process that is there")
    to.parent.mkdir(mode=0o700)
    (to.parent / f".importing-n.{gone.pid}").mkdir()
    there = (
        "import sys; from pathlib import Path; from factorbus.journal.bundle import {0}; {0}(*map(Path, sys.argv[1:]))"
    )
    copy_to, unpack = Store.copy_to, bundle._unpack

    def in_another_process(name: str, *paths: Path) -> None:
        subprocess.run([sys.executable, "-c", there.format(name), *map(str, paths)], check=True, timeout=60)

    def copied(reading: Store, path: Path) -> None:
        copy_to(reading, path)
        in_another_process("export_map", store.path.parent, file)

    def unpacked(folder: Path, name: str) -> None:
        unpack(folder, name)
        in_another_process("import_map", file, to)

    monkeypatch.setattr(Store, "copy_to", copied)
    export_map(store.path.parent, file)
    monkeypatch.setattr(Store, "copy_to", copy_to)
    monkeypatch.setattr(bundle, "_unpack", unpacked)
    with pytest.raises(MapThere):
        import_map(file, to)
    again = open_store(to, read_only=True)
    assert list(again.records()) == list(store.records())
    again.close()
    assert sorted(p.name for p in to.parent.iterdir()) == ["n"]
    assert sorted(p.name for p in tmp_path.glob("*.part")) == [".m.fbmap.1.part"]
