"""What is said of a file that is no exported map, of a way out that cannot be, and of journals that are damaged."""

import json
import shutil
import sqlite3
import threading
from pathlib import Path

import pytest

from factorbus.cli.main import main
from factorbus.journal.bundle import export_map, import_map
from factorbus.journal.connecting import FORM_WITH_BUDGETS
from factorbus.journal.digest import sealed
from factorbus.journal.problems import JournalFailed, NoJournal
from factorbus.journal.records import ACCEPTED, Entry, JournalRecord
from factorbus.journal.store import NAME, Store, create, open_store
from factorbus.proto.problems import Problem
from factorbus.service.config import Config
from factorbus.service.journal.library import open_library


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """A map with so many inserts that it has many pages."""
    made = create(tmp_path / "m", "m", "inc-l", {}, 77, "commit")
    entries = (sealed(Entry("a", n, 0, ACCEPTED, n, n, 1, b"", bytes(900))) for n in range(1, 201))
    made.append([JournalRecord(n, n, False, bytes([n]) * 16, (entry,)) for n, entry in enumerate(entries, 1)])
    return made


def test_a_file_that_is_no_exported_map_is_named_with_what_is_wanted(store: Store, tmp_path: Path) -> None:
    export_map(store.path.parent, tmp_path / "m.fbmap")
    (tmp_path / "broken").write_bytes((tmp_path / "m.fbmap").read_bytes()[:5000])
    (tmp_path / "town.g2o").write_text("VERTEX_SE2 0 0 0 0\n")
    with sqlite3.connect(tmp_path / "else.db") as database:
        database.execute("CREATE TABLE a (b)")
    database.close()
    (tmp_path / "newer").write_bytes((tmp_path / "m.fbmap").read_bytes())
    with sqlite3.connect(tmp_path / "newer") as database:
        database.execute(f"PRAGMA user_version = {FORM_WITH_BUDGETS + 1}")
    database.close()
    for file, code, words in (
        ("broken", "bad_file", "is damaged: "),
        ("town.g2o", "bad_file", "is no exported map; wanted a file that `factorbus export` wrote"),
        ("else.db", "bad_file", "is no exported map"),
        ("nofile", "bad_file", "cannot be read: No such file"),
        (".", "bad_file", "cannot be read: Is a directory"),
        ("newer", "journal_version", "a newer version wrote it"),
    ):
        with pytest.raises(Problem, match=words) as caught:
            import_map(tmp_path / file, tmp_path / "other" / "b")
        assert (caught.value.code, str(tmp_path / file) in str(caught.value)) == (code, True)
        assert ".importing" not in str(caught.value)
    assert not list((tmp_path / "other").glob("*")), "nothing half done is left"


def test_of_an_export_that_cannot_be_the_way_out_is_said(store: Store, tmp_path: Path) -> None:
    folder = store.path.parent
    with pytest.raises(NoJournal, match=f"there is no journal .*nope; there are {folder.name}"):
        export_map(folder.parent / "nope", tmp_path / "m.fbmap")
    with pytest.raises(NoJournal, match=r"there is no journal .*nowhere; name the folder that"):
        export_map(folder.parent / "nowhere" / "m", tmp_path / "m.fbmap")
    for target in (tmp_path / "missing" / "m.fbmap", Path("/proc/m.fbmap")):
        with pytest.raises(JournalFailed, match=r"cannot be written .*: nothing was changed") as failed:
            export_map(folder, target)
        assert "questions" not in failed.value.message, "no service is meant"
        assert "retry_after_s" not in failed.value.detail


def test_a_service_whose_folder_cannot_be_made_says_that_it_does_not_start(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    for folder in (tmp_path / "file", Path("/proc/x")):
        with pytest.raises(JournalFailed, match=r"cannot be written .*: the service does not start") as failed:
            open_library(Config(journal=str(folder)), print, threading.Event())
        assert (failed.value.code, "send again" in failed.value.message) == ("journal_failed", False)


def test_one_that_does_not_open_hides_no_other(
    store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store.close()
    for name in ("a", "z"):
        create(tmp_path / "maps" / name, name, "inc-l", {}, 7, "commit").close()
    shutil.copytree(tmp_path / "maps" / "a", tmp_path / "maps" / "k")
    (tmp_path / "maps" / "k" / NAME).write_bytes(b"not a database" * 100)
    at = ["--journal", str(tmp_path / "maps")]
    assert main(["journal", "show", *at]) == 5
    told = capsys.readouterr()
    assert [name in told.out for name in ("a", "k", "z")] == [True] * 3
    assert ("durability" in told.out.split("\nz")[1], "[journal_damaged]" in told.err) == (True, True)
    assert main(["journal", "show", "--json", *at]) == 5
    rows = json.loads(capsys.readouterr().out)["maps"]
    assert [(row["map"], row.get("code")) for row in rows] == [("a", None), ("k", "journal_damaged"), ("z", None)]
    assert main(["journal", "verify", *at]) == 5
    assert [line.partition(":")[0] for line in capsys.readouterr().out.splitlines()] == ["a", "k", "z"]
    assert main(["journal", "check", *at]) == 1
    assert "`factorbus drop k --damaged`" in capsys.readouterr().out


def test_pages_that_are_not_what_was_written_are_one_sentence(store: Store) -> None:
    store.close()
    with store.path.open("r+b") as file:
        for page in range(3, 30):
            file.seek(4096 * page)
            file.write(bytes(4096))
    again = open_store(store.path.parent, read_only=True)
    said = list(again.check())
    again.close()
    (pages,) = (each for each in said if "SQLite" in each)
    assert "the pages of its database are not what was written" in pages
    assert "\n" not in pages
