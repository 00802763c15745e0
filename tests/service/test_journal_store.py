"""Journals on disk: what is written is read, what is wrong is found, and a folder has one owner."""

import os
import random
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from factorbus.cli.main import main
from factorbus.journal import chain
from factorbus.journal.bundle import export_map, import_map
from factorbus.journal.checkpoints import file_of, read_checkpoint, remove_strangers, write_checkpoint
from factorbus.journal.connecting import FORM, FORM_WITH_BUDGETS
from factorbus.journal.digest import sealed
from factorbus.journal.folders import left_behind, maps_in
from factorbus.journal.lock import own
from factorbus.journal.problems import (
    BadFile,
    JournalDamaged,
    JournalFailed,
    JournalInUse,
    JournalVersion,
    MapThere,
    NoJournal,
    NotWritten,
)
from factorbus.journal.records import ACCEPTED, REFUSED, Entry, Epoch, JournalRecord
from factorbus.journal.store import NAME, Checkpoint, Store, create, open_store


def entry(client: str, sequence: int, message: bytes = b"hello") -> Entry:
    return sealed(Entry(client, sequence, 0, ACCEPTED, sequence, 10 * sequence, 1, b"", message))


def record(number: int, *entries: Entry) -> JournalRecord:
    return JournalRecord(number, number, False, bytes([number]) * 16, entries)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    made = create(tmp_path / "m", "m", "inc-l", {"mode": "inc-l", "incremental_tolerance": 1e-3}, 77, "commit")
    made.append([record(1, entry("a", 1), entry("b", 1)), record(2, entry("a", 2, b"more"))])
    made.append([record(3, sealed(entry("a", 3)._replace(outcome=REFUSED, answer=b"why")), entry("b", 2))])
    return made


def test_what_was_written_is_there_when_it_is_opened_again(store: Store) -> None:
    store.close()
    again = open_store(store.path.parent)
    header = again.header()
    assert (header.map, header.mode, header.options["incremental_tolerance"], header.epoch) == ("m", "inc-l", 1e-3, 77)
    assert [(f.number, [(e.client, e.sequence) for e in f.entries]) for f in again.records(1)] == [
        (2, [("a", 2)]),
        (3, [("a", 3), ("b", 2)]),
    ]
    assert again.last() == (3, 3, b"\x03" * 16)
    assert again.last_at(2).chain == b"\x02" * 16
    assert list(again.check()) == []
    assert again.counts() == {"records": 3, "inserts": 5, "clients": 2, "message_bytes": 24}


def test_clients_are_where_they_were_and_the_one_heard_last_comes_last(store: Store) -> None:
    assert [(s.client, s.next, [e.sequence for e in s.entries]) for s in store.senders(1, 10, 2)] == [
        ("a", 4, [2, 3]),
        ("b", 3, [1, 2]),
    ]
    assert [s.client for s in store.senders(1, 1, 5)] == ["b"]
    store.begin("commit", Epoch(78, 4, "a test"))
    assert store.senders(store.header().epochs[-1].record, 10, 10) == []
    store.append([record(4, entry("a", 1))])
    assert [(s.client, s.next) for s in store.senders(4, 10, 10)] == [("a", 2)]
    assert list(store.check()) == [], "numbers begin anew in another epoch"


def test_a_transaction_is_there_wholly_or_not_at_all(store: Store) -> None:
    with pytest.raises(JournalFailed, match="UNIQUE"):
        store.append([record(4, entry("a", 4)), record(3)])
    assert store.last().record == 3
    assert len(list(store.records())) == 3


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        ("UPDATE entry SET message = x'00' WHERE number = 3", "insert 2 of client a is not what was written"),
        ("UPDATE entry SET revision = 9 WHERE number = 3", "insert 2 of client a is not what was written"),
        ("UPDATE entry SET outcome = 1 WHERE number = 3", "insert 2 of client a is not what was written"),
        ("DELETE FROM record WHERE number = 2", "record 2 is missing"),
        ("DELETE FROM entry WHERE number = 3", "client a has number 3 after 1"),
        ("UPDATE entry SET record = 9 WHERE number = 5", "record 9, which is missing"),
        ("UPDATE entry SET client = 'c' WHERE number = 3", "insert 2 of client c is not what was written"),
        ("UPDATE record SET revision = 0 WHERE number = 3", "goes back from revision 2 to 0"),
    ],
)
def test_check_finds_what_is_wrong(store: Store, damage: str, said: str) -> None:
    store.close()
    with sqlite3.connect(store.path) as database:
        database.execute(damage)
    database.close()
    assert any(said in each for each in open_store(store.path.parent).check())


def test_a_page_of_nonsense_is_damage_and_not_a_map(store: Store) -> None:
    store.close()
    size = store.path.stat().st_size
    with store.path.open("r+b") as file:
        for page in range(1, size // 4096):
            file.seek(4096 * page)
            file.write(os.urandom(4096))
    again = open_store(store.path.parent)
    with pytest.raises(JournalDamaged):
        again.header()
    with pytest.raises(JournalDamaged):
        list(again.records())
    assert list(again.check())


def long_journal(folder: Path) -> Store:
    """Twenty transactions, of one to four records each, in the log and not in the database yet."""
    made = create(folder, "m", "inc-l", {}, 77, "commit")
    number = 0
    for turn in range(20):
        more = range(number + 1, number + 2 + turn % 4)
        made.append([record(n, entry("a", n, bytes([n]) * (n * 37 % 5000))) for n in more])
        number = more[-1]
    return made


def test_a_log_cut_anywhere_is_a_journal_of_whole_transactions(tmp_path: Path) -> None:
    made = long_journal(tmp_path / "m")
    whole = list(made.records())
    ends = [0, *(fold_.number for fold_ in whole)]
    content = made.path.with_name("journal.db-wal").read_bytes()
    chance, seen = random.Random(3), set[int]()
    for n in range(40):
        end = len(content) - chance.randrange(200) if n < 10 else chance.randrange(32, len(content))
        cut = tmp_path / f"cut{n}"
        cut.mkdir()
        shutil.copyfile(made.path, cut / NAME)
        (cut / "journal.db-wal").write_bytes(content[:end] + chance.randbytes(chance.choice((0, 100, 5000))))
        again = open_store(cut)
        assert list(again.records()) == whole[: again.last().record]
        assert list(again.check()) == []
        assert again.last().record in ends
        seen.add(again.last().record)
        again.append([record(again.last().record + 1, entry("b", 1))])
        again.close()
    assert len(seen) > 5
    made.close()


def test_a_page_torn_while_the_log_was_put_into_the_database_is_whole_again(tmp_path: Path) -> None:
    """What a power cut in the middle of that leaves: half of a page of the log in the database, and all of the log."""
    made = long_journal(tmp_path / "m")
    whole = list(made.records())
    log = made.path.with_name("journal.db-wal").read_bytes()
    made.close()  # puts it in
    content, chance = made.path.read_bytes(), random.Random(5)
    pages = sorted({int.from_bytes(log[at : at + 4], "big") - 1 for at in range(32, len(log), 24 + 4096)})
    for n, page in enumerate([pages[-1], *chance.sample(pages, 10)]):
        torn = tmp_path / f"torn{n}"
        torn.mkdir()
        half = 4096 * page + 512 * chance.randrange(1, 8)
        (torn / NAME).write_bytes(
            content[:half] + chance.randbytes(4096 * (page + 1) - half) + content[4096 * (page + 1) :]
        )
        (torn / "journal.db-wal").write_bytes(log)
        again = open_store(torn)
        assert list(again.records()) == whole
        assert list(again.check()) == []
        again.close()


def test_a_torn_page_without_a_log_is_never_taken_for_the_journal(tmp_path: Path) -> None:
    """A disk that lost what it had confirmed: damage, or every bit is there (the page's free part was torn)."""
    made = long_journal(tmp_path / "m")
    whole = list(made.records())
    made.close()
    content, chance, found = made.path.read_bytes(), random.Random(6), 0
    for n in range(60):
        page, torn = chance.randrange(len(content) // 4096), tmp_path / f"torn{n}"
        torn.mkdir()
        half = 4096 * page + 512 * chance.randrange(8)
        junk = chance.choice((bytes(4096), chance.randbytes(4096)))[: 4096 * (page + 1) - half]
        (torn / NAME).write_bytes(content[:half] + junk + content[4096 * (page + 1) :])
        try:
            again = open_store(torn)
        except JournalDamaged:
            found += 1
            continue
        said = list(again.check())
        found += bool(said)
        try:
            came = list(again.records())
            again.header()
        except JournalDamaged:
            assert said
        else:
            assert came == whole or said
        again.close()
    assert found > 20


def test_a_journal_that_was_not_finished_is_not_there(tmp_path: Path) -> None:
    made = create(tmp_path / "m", "m", "inc-l", {}, 7, "commit")
    made.close()
    for begun in (".making-n", ".dropped-n-12ab"):
        shutil.copytree(tmp_path / "m", tmp_path / begun)
    assert maps_in(tmp_path, NAME) == ["m"]
    assert sorted(path.name for path in left_behind(tmp_path)) == [".dropped-n-12ab", ".making-n"]
    create(tmp_path / "n", "n", "inc-l", {}, 7, "commit").close()
    assert maps_in(tmp_path, NAME) == ["m", "n"]


def test_of_another_form_or_no_journal_at_all(store: Store, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    store.close()
    for form, words in (
        (FORM_WITH_BUDGETS + 1, "a newer version wrote it"),
        (FORM - 1, "export it with the version that wrote it"),
    ):
        with sqlite3.connect(store.path) as database:
            database.execute(f"PRAGMA user_version = {form}")
        database.close()
        with pytest.raises(JournalVersion, match=words) as caught:
            open_store(store.path.parent)
        assert caught.value.code == "journal_version"
        assert main(["journal", "show", "--journal", str(tmp_path)]) != 0
        assert "[journal_version]" in capsys.readouterr().err
    store.path.write_bytes(b"not a database" * 100)
    with pytest.raises(JournalDamaged):
        open_store(store.path.parent)
    with pytest.raises(NoJournal):
        open_store(tmp_path / "nothing")


def test_a_checkpoint_comes_back_to_the_bit_or_not_at_all(tmp_path: Path) -> None:
    state = {
        "numbers": np.array([[1.5, -0.0], [np.nan, 0.0]]),
        "none": np.zeros((0, 3)),
        "many": np.arange(7),
        "inner": {"list": [1, "two", None], "zero": np.zeros(5, np.int64)},
    }
    path = file_of(tmp_path, 12)
    assert write_checkpoint(path, state) == path.stat().st_size
    back = read_checkpoint(path)
    assert back["inner"]["list"] == [1, "two", None]
    for one, other in ((state["numbers"], back["numbers"]), (state["many"], back["many"])):
        assert one.tobytes() == other.tobytes()  # type: ignore[attr-defined]
    assert back["none"].shape == (0, 3)
    content = bytearray(path.read_bytes())
    for at in range(0, len(content), 7):
        content[at] ^= 1
        path.write_bytes(content)
        with pytest.raises(ValueError, match="damaged or incomplete"):
            read_checkpoint(path)
        content[at] ^= 1
    path.write_bytes(content[:-1])
    with pytest.raises(ValueError, match="damaged or incomplete"):
        read_checkpoint(path)


def test_checkpoints_that_nobody_noted_go(store: Store) -> None:
    folder = store.path.parent
    for number in (1, 2, 3):
        write_checkpoint(file_of(folder, number), {"n": number})
        saved = Checkpoint(number, 1, {"sources": "here"}, "", 10)
        assert store.add_checkpoint(saved, 2) == ([1] if number == 3 else [])
    (folder / "checkpoint-4.part").write_bytes(b"begun")
    remove_strangers(folder, {saved.record for saved in store.checkpoints()})
    assert sorted(p.name for p in folder.glob("checkpoint*")) == ["checkpoint-2.fbs", "checkpoint-3.fbs"]


def test_a_map_is_one_file_and_back(store: Store, tmp_path: Path) -> None:
    write_checkpoint(file_of(store.path.parent, 3), {"state": np.arange(5)})
    store.add_checkpoint(Checkpoint(3, 1, {"sources": "here"}, "", 1), 2)
    export_map(store.path.parent, tmp_path / "m.fbmap")  # while it is open for writing
    import_map(tmp_path / "m.fbmap", tmp_path / "other" / "n")
    again = open_store(tmp_path / "other" / "n")
    assert list(again.records()) == list(store.records())
    assert (again.header().map, again.header().epoch) == ("n", 77)
    assert read_checkpoint(file_of(tmp_path / "other" / "n", 3))["state"].tolist() == [0, 1, 2, 3, 4]
    with pytest.raises(MapThere, match="there is a map 'n'"):
        import_map(tmp_path / "m.fbmap", tmp_path / "other" / "n")
    (tmp_path / "broken").write_bytes((tmp_path / "m.fbmap").read_bytes()[:5000])
    with pytest.raises(BadFile, match="is damaged"):
        import_map(tmp_path / "broken", tmp_path / "other" / "b")
    assert sorted(p.name for p in (tmp_path / "other").iterdir()) == ["n"], "nothing half done is left"


def test_a_copy_has_no_checkpoint_that_its_journal_does_not_know_and_knows_of_none_that_it_has_not(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service writes a checkpoint, and removes an older one, while the map is copied."""
    folder = store.path.parent
    for number in (1, 2):
        write_checkpoint(file_of(folder, number), {"n": number})
        store.add_checkpoint(Checkpoint(number, 1, {"sources": "here"}, "", 1), 2)
    copy_to = Store.copy_to

    def and_meanwhile(reading: Store, path: Path) -> None:
        copy_to(reading, path)
        write_checkpoint(file_of(folder, 3), {"n": 3})
        for record in store.add_checkpoint(Checkpoint(3, 1, {"sources": "here"}, "", 1), 2):
            file_of(folder, record).unlink()

    monkeypatch.setattr(Store, "copy_to", and_meanwhile)
    export_map(folder, tmp_path / "m.fbmap")
    import_map(tmp_path / "m.fbmap", tmp_path / "other" / "n")
    again = open_store(tmp_path / "other" / "n", read_only=True)
    assert [saved.record for saved in again.checkpoints()] == [2]
    assert [path.name for path in (tmp_path / "other" / "n").glob("checkpoint*")] == ["checkpoint-2.fbs"]
    again.close()


def test_a_journal_at_work_is_neither_imported_nor_written_over(store: Store, tmp_path: Path) -> None:
    """A part of it is in its log; and who exports into its folder may name a file of it."""
    (tmp_path / "link").symlink_to(store.path)
    for file in (store.path, tmp_path / "link"):
        with pytest.raises(BadFile, match=f"a part of which is in {NAME}-wal"):
            import_map(file, tmp_path / "other" / "n")
    before = list(store.records())
    for name in (NAME, "copy.fbmap"):
        with pytest.raises(NotWritten, match="the journal of a map"):
            export_map(store.path.parent, store.path.parent / name)
    assert list(store.records()) == before
    assert not (tmp_path / "other" / "n").exists()


def test_one_owner_until_it_ends_however_it_ends(tmp_path: Path) -> None:
    program = (
        "import sys, pathlib; from factorbus.journal.lock import own; o = own(pathlib.Path(sys.argv[1]));"
        "o.say('process 17 on mars'); print('mine', flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == "mine\n"
        with pytest.raises(JournalInUse, match="process 17 on mars"):
            own(tmp_path)
        stop, told = threading.Event(), []
        stop.set()
        assert own(tmp_path, stop, told.append) is None
        assert told == ["process 17 on mars"]
        owner.send_signal(signal.SIGKILL)
        taken = own(tmp_path, threading.Event())
        assert taken is not None
        taken.release()


def test_the_chain_follows_values_and_time_stamps_and_not_reports() -> None:
    from factorbus.proto import codec
    from factorbus.proto.messages import Delta, Variables

    def delta(value: float, ms: float, stamp: int | None = None) -> bytes:
        stamps = None if stamp is None else np.array([stamp])
        rows = (Variables("se2", np.array([1]), np.array([[value, 0.0, 0.0]]), stamps=stamps),)
        return codec.encode_delta(Delta(1, 2, 1, rows, {"step_ms": ms}))

    one = chain.extend_chain(chain.START, delta(1.0, 3.0))
    assert one == chain.extend_chain(chain.START, delta(1.0, 4.0))
    assert one != chain.extend_chain(chain.START, delta(np.nextafter(1.0, 2.0), 3.0))
    assert one != chain.extend_chain(one, delta(1.0, 3.0))
    assert len({one, *(chain.extend_chain(chain.START, delta(1.0, 3.0, stamp)) for stamp in (0, 1))}) == 3
    assert NAME == "journal.db"
