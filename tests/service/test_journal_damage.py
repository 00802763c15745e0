"""A journal whose files were damaged, in whatever way: it says so, or every bit of it is there."""

import random
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from factorbus.journal.digest import sealed
from factorbus.journal.folders import maps_in
from factorbus.journal.log_frames import lost_from
from factorbus.journal.problems import JournalDamaged, JournalUnreadable, JournalVersion
from factorbus.journal.records import ACCEPTED, Entry, Epoch, JournalRecord
from factorbus.journal.store import NAME, create, open_store
from factorbus.service.config import Config, Limits
from factorbus.service.journal import library
from factorbus.service.journal.library import open_library

PAGE, FRAME = 4096, 4096 + 24
LOG, INDEX = f"{NAME}-wal", f"{NAME}-shm"
OPTIONS = {"mode": "bayes-tree", "incremental_tolerance": 5e-5}


def entry(client: str, sequence: int, message: bytes) -> Entry:
    return sealed(Entry(client, sequence, 0, ACCEPTED, sequence, 10 * sequence, 1, b"answer", message))


def record(number: int) -> JournalRecord:
    message = bytes([number % 251]) * (number * 137 % 3000)
    return JournalRecord(
        number, number, False, bytes([number % 251]) * 16, (entry("ab"[number % 2], (number + 1) // 2, message),)
    )


def written(folder: Path, durability: str = "commit", name: str = "m") -> Path:
    """Forty transactions, as a process that was killed leaves them: in the log, and counted by its index."""
    made = create(folder / "alive" / name, name, "bayes-tree", OPTIONS, 77, durability)
    for number in range(1, 41):
        made.append([record(number)])
    left = folder / name
    shutil.copytree(folder / "alive" / name, left)
    made.close()
    shutil.rmtree(folder / "alive")
    return left


def closed(folder: Path) -> Path:
    """The same, as a process that was stopped leaves them: all in the database."""
    left = written(folder)
    open_store(left).close()
    assert [path.name for path in left.iterdir()] == [NAME]
    return left


def content(folder: Path) -> tuple[object, ...]:
    """All that a service reads of it.  Raises Problem."""
    store = open_store(folder)
    try:
        store.check_form()
        return store.header(), store.last(), list(store.records()), store.senders(1, 256, 1024), store.checkpoints()
    finally:
        store.close()


def change(path: Path, at: int, mask: int = 1) -> None:
    data = bytearray(path.read_bytes())
    data[at] ^= mask
    path.write_bytes(data)


def test_a_bit_of_the_log_is_not_the_end_of_it_through_a_link(tmp_path: Path) -> None:
    """The log is beside what the link leads to."""
    folder, linked = written(tmp_path), tmp_path / "linked"
    linked.mkdir(mode=0o700)
    (linked / NAME).symlink_to(folder / NAME)
    change(folder / LOG, 20 * FRAME)
    with pytest.raises(JournalDamaged):
        open_store(linked, read_only=True)


_TAKES_INDEX = """
import fcntl, sys
with open(sys.argv[1], "rb+") as index:
    try:
        fcntl.lockf(index, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, 128)  # as SQLite does before it cuts off one that was left
    except BlockingIOError:
        sys.exit(9)
"""


def index_is_held(folder: Path) -> bool:
    """Whether another process sees that somebody has the index of the log open."""
    return subprocess.run([sys.executable, "-c", _TAKES_INDEX, str(folder / INDEX)], check=False).returncode == 9


def test_who_reads_it_beside_who_writes_it_takes_no_locks_from_the_writer(tmp_path: Path) -> None:
    """A service reads the journal that it writes, for a fork or a replica, say; other processes may open it then."""
    folder = tmp_path / "m"
    made = create(folder, "m", "bayes-tree", OPTIONS, 77, "commit")
    made.append([record(1)])
    assert index_is_held(folder)
    for _ in range(2):
        other = open_store(folder, read_only=True)
        assert index_is_held(folder)
        other.close()
        assert index_is_held(folder)
    made.append([record(2)])
    made.close()
    assert not index_is_held(folder)
    assert content(folder)[2] == [record(1), record(2)]


@pytest.mark.parametrize("at", [0, 5, 17, 24, 31, 32, 36, 40, 50, 60, 20 * FRAME, 30 * FRAME + 777])
def test_a_bit_of_the_log_is_not_the_end_of_it(tmp_path: Path, at: int) -> None:
    """SQLite would take what is before it for all there was.  Without the index, as after a power cut."""
    folder = written(tmp_path)
    (folder / INDEX).unlink()
    assert lost_from(folder / NAME) == ""
    change(folder / LOG, at)
    left = {path.name: path.read_bytes() for path in folder.iterdir()}
    for read_only in (False, True):
        with pytest.raises(JournalDamaged, match="its log is not whole from"):
            open_store(folder, read_only=read_only)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == left, "nothing was changed"


@pytest.mark.parametrize("frames", [0, 1, 20, -1])
def test_a_log_that_was_cut_has_less_than_its_index_counts(tmp_path: Path, frames: int) -> None:
    folder = written(tmp_path)
    log = (folder / LOG).read_bytes()
    (folder / LOG).write_bytes(log[: 32 + frames * FRAME] if frames >= 0 else b"")
    with pytest.raises(JournalDamaged, match="frames that are whole, and had"):
        open_store(folder)
    (folder / LOG).unlink()
    with pytest.raises(JournalDamaged, match="frames that are whole, and had"):
        open_store(folder)


def test_what_was_being_written_when_the_power_went_was_not_confirmed(tmp_path: Path) -> None:
    """The pages of the last transaction get to the disk in any order, and without the index."""
    folder, last = written(tmp_path), 0
    (folder / INDEX).unlink()
    log = (folder / LOG).read_bytes()
    ends = [n for n in range(len(log) // FRAME) if any(log[32 + n * FRAME + 4 : 32 + n * FRAME + 8])]
    for frame in range(ends[-2] + 1, ends[-1] + 1):
        (folder / LOG).write_bytes(log)
        change(folder / LOG, 32 + frame * FRAME + 999)
        assert lost_from(folder / NAME) == ""
        last = frame
    assert last == ends[-1]
    assert content(folder)[1] == (39, 39, record(39).chain)


def test_a_journal_that_promises_nothing_opens_with_what_there_is(tmp_path: Path) -> None:
    folder = written(tmp_path, "none")
    change(folder / LOG, 20 * FRAME)
    assert lost_from(folder / NAME)
    store = open_store(folder)
    assert 0 < store.last().record < 40
    store.close()


def test_frames_of_before_a_checkpoint_are_not_missed(tmp_path: Path) -> None:
    folder = written(tmp_path)
    store = open_store(folder)
    with sqlite3.connect(folder / NAME) as database:
        assert database.execute("PRAGMA wal_checkpoint(RESTART)").fetchone()[0] == 0
    store.append([record(41)])  # over the first of many frames
    assert lost_from(folder / NAME) == ""
    open_store(folder, read_only=True).close()
    database.close()
    store.close()


DAMAGE: dict[str, Callable[[bytearray, random.Random], bytes]] = {}


def damage(make: Callable[[bytearray, random.Random], bytes]) -> Callable[[bytearray, random.Random], bytes]:
    DAMAGE[make.__name__] = make
    return make


@damage
def bit(data: bytearray, chance: random.Random) -> bytes:
    data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return data


@damage
def numbers(data: bytearray, chance: random.Random) -> bytes:
    for _ in range(chance.choice((1, 3, 20, 200))):
        data[chance.randrange(len(data))] = chance.randrange(256)
    return data


@damage
def page_of_zeros(data: bytearray, chance: random.Random) -> bytes:
    at = PAGE * chance.randrange(len(data) // PAGE)
    data[at : at + PAGE] = bytes(PAGE)
    return data


@damage
def page_of_nonsense(data: bytearray, chance: random.Random) -> bytes:
    at = PAGE * chance.randrange(len(data) // PAGE)
    data[at : at + PAGE] = chance.randbytes(PAGE)
    return data


@damage
def page_of_another(data: bytearray, chance: random.Random) -> bytes:
    one, other = (PAGE * chance.randrange(len(data) // PAGE) for _ in range(2))
    data[one : one + PAGE] = data[other : other + PAGE]
    return data


@damage
def pages_swapped(data: bytearray, chance: random.Random) -> bytes:
    one, other = (PAGE * chance.randrange(len(data) // PAGE) for _ in range(2))
    data[one : one + PAGE], data[other : other + PAGE] = data[other : other + PAGE], data[one : one + PAGE]
    return data


@damage
def cut(data: bytearray, chance: random.Random) -> bytes:
    return data[: chance.choice((0, chance.randrange(len(data)), PAGE * chance.randrange(len(data) // PAGE)))]


@pytest.mark.parametrize("kind", DAMAGE)
@pytest.mark.parametrize("left", [written, closed])
def test_whatever_is_damaged_is_said_or_all_there(tmp_path: Path, left: Callable[[Path], Path], kind: str) -> None:
    folder, found = left(tmp_path), 0
    for seed in range(40):
        chance, copy = random.Random(f"{kind} {seed}"), tmp_path / f"copy{seed}"
        shutil.copytree(folder, copy)
        path = copy / chance.choice([name for name in (NAME, LOG) if (copy / name).exists()])
        path.write_bytes(DAMAGE[kind](bytearray(path.read_bytes()), chance))
        try:
            header, _, records, senders, _ = content(copy)
        except (JournalDamaged, JournalVersion):
            found += 1
            continue
        assert (header.map, header.mode, header.options) == ("m", "bayes-tree", OPTIONS), seed  # type: ignore[attr-defined]
        assert header.epochs == (Epoch(77, 1, "created"),), seed  # type: ignore[attr-defined]
        assert [each._replace(chain=b"") for each in records] == [
            record(n)._replace(chain=b"") for n in range(1, 41)
        ], seed  # a bit of a chain begins a new epoch
        assert [sender.next for sender in senders] == [21, 21], seed  # type: ignore[attr-defined]
    assert found > 10


@pytest.mark.parametrize(
    "statement",
    [
        "DELETE FROM epoch",
        "UPDATE epoch SET epoch = 78",
        "UPDATE epoch SET because = x'ff'",
        "UPDATE header SET value = 'inc-l' WHERE name = 'mode'",
        """UPDATE header SET value = '{"mode": "bayes-tree", "incremental_tolerance": 6e-5}' WHERE name = 'options'""",
        "UPDATE header SET value = '[1]' WHERE name = 'options'",
        "UPDATE header SET value = CAST(x'ff' AS TEXT) WHERE name = 'mode'",
        "DELETE FROM header WHERE name = 'seal'",
        "DELETE FROM header WHERE name = 'clean'",
        "DELETE FROM header WHERE name = 'durability'",
        "DELETE FROM header WHERE name = 'map'",
        "UPDATE entry SET client = CAST(x'ff' AS TEXT) WHERE number = 3",
        "UPDATE entry SET message = 'text' WHERE number = 3",
        "UPDATE entry SET sequence = 'text' WHERE number = 3",
        "DROP TABLE checkpoint",
    ],
)
def test_rows_that_are_not_what_was_written_are_damage(tmp_path: Path, statement: str) -> None:
    folder = closed(tmp_path)
    with sqlite3.connect(folder / NAME) as database:
        database.execute(statement)
    database.close()
    with pytest.raises(JournalDamaged):
        content(folder)


def test_a_client_that_an_index_lost_is_missed(tmp_path: Path) -> None:
    """Its numbers would begin anew, and what it sends again would be there twice."""
    folder = closed(tmp_path)
    with sqlite3.connect(folder / NAME) as database:
        (root,) = database.execute("SELECT rootpage FROM sqlite_master WHERE name = 'entry_of_client'").fetchone()
    database.close()
    data = bytearray((folder / NAME).read_bytes())
    data[(root - 1) * PAGE + 3 : (root - 1) * PAGE + 5] = bytes(2)  # it has no cells
    (folder / NAME).write_bytes(data)
    with pytest.raises(JournalDamaged):
        content(folder)


def test_what_the_disk_does_not_give_is_not_damage(tmp_path: Path) -> None:
    folder = closed(tmp_path)
    (folder / LOG).mkdir()
    with pytest.raises(JournalUnreadable, match=r"journal\.db-wal"):
        open_store(folder)


def test_a_map_whose_database_is_gone_is_still_a_map(tmp_path: Path) -> None:
    for name in ("m", "n"):
        written(tmp_path, name=name)
        (tmp_path / name / NAME).unlink()
    (tmp_path / "n" / LOG).rename(tmp_path / "n" / "checkpoint-3.fbs")
    (tmp_path / "else").mkdir(mode=0o700)
    (tmp_path / "else" / "notes.txt").write_text("no map")
    assert maps_in(tmp_path, NAME) == ["m", "n"]
    tmp_path.chmod(0o700)
    there = open_library(Config(journal=str(tmp_path)), lambda _: None, None)
    assert there is not None
    with pytest.raises(JournalDamaged, match=r"journal\.db is missing"):
        there.open("m", Limits())
    there.close()


def test_a_fault_in_opening_one_map_is_a_problem_of_that_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    written(tmp_path)
    tmp_path.chmod(0o700)

    def fault(*_: object) -> None:
        raise LookupError("of no kind that is known")

    monkeypatch.setattr(library, "recover", fault)
    there = open_library(Config(journal=str(tmp_path)), lambda _: None, None)
    assert there is not None
    with pytest.raises(JournalDamaged, match="LookupError"):
        there.open("m", Limits())
    there.close()
    assert "of no kind that is known" in caplog.text
