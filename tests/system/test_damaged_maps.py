"""A map whose journal is damaged: it is listed as that, the others open, and an operator can give it up."""

import json
import signal
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from bare import bare, start
from journalled import Services, drafts

from factorbus.cli.doctor.service_checks import services as look_at
from factorbus.client import Problem, Refused, connect
from factorbus.client.bus import Bus
from factorbus.journal.store import NAME
from factorbus.proto import codec, keys
from factorbus.proto.messages import Insert

Ran = "subprocess.CompletedProcess[str]"


def factorbus(*arguments: str) -> Ran:
    return subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *arguments], capture_output=True, text=True, timeout=100, check=False
    )


def damage(journal: Path, name: str) -> None:
    """An insert is not what was written."""
    with sqlite3.connect(journal / name / NAME) as database:
        database.execute("UPDATE entry SET message = x'00' WHERE number = 2")
    database.close()


def fill(bus: Bus, name: str, count: int = 5) -> None:
    with bus.map(name, mirror=False) as joined:
        for batch in drafts(count):
            joined.insert(batch)


def code_of(call: Callable[[], object]) -> tuple[str, str]:
    with pytest.raises(Problem) as refused:
        call()
    return refused.value.code, str(refused.value)


def refused_insert(endpoint: str) -> tuple[str, int]:
    """Its code, and the number that is wanted next, of an insert of a client that was there before."""
    with bare(endpoint) as client:
        came = client.ask(keys.insert_key("m", "before-1"), codec.encode_insert(Insert(1, start())))
    assert isinstance(came, Refused)
    return came.code, came.detail["next"]


def test_a_damaged_map_can_be_seen_and_given_up(services: Callable[..., Services], tmp_path: Path) -> None:
    service = services(tmp_path / "journal")
    with connect(service.start(), client="before", timeout_s=60) as bus:
        for name in ("m", "hall"):
            fill(bus, name)
    service.end(signal.SIGTERM)
    damage(tmp_path / "journal", "m")
    endpoint = service.start()
    with connect(endpoint, client="after", timeout_s=60) as bus:
        hall, m = bus.maps()
        assert (hall.name, hall.state, hall.problem, hall.revision) == ("hall", "open", "", 5)
        assert (m.name, m.state, m.epoch, m.revision) == ("m", "damaged", 0, 0)
        assert "is damaged" in m.problem
        assert "factorbus drop MAP --damaged" in m.problem
        (told,) = bus.stats()
        assert [(row["name"], row["state"], row["code"]) for row in told["unopened"]] == [
            ("m", "damaged", "journal_damaged")
        ]
        assert [row["name"] for row in told["maps"]] == ["hall"]
        (finding,) = look_at(endpoint, "")
        assert (finding.state, "map m does not open (damaged)" in finding.seen) == ("fail", True)
        assert "factorbus drop m --damaged" in finding.mend
        shown = factorbus("stats", "--connect", endpoint)
        assert "does not open (damaged)" in " ".join(shown.stdout.split())

        listed = " ".join(factorbus("maps", "--connect", endpoint).stdout.split())
        assert "m does not open (damaged): `factorbus stats m` says why, `factorbus drop m --damaged` gives" in listed

        for call in (lambda: bus.map("m"), lambda: bus.drop("m"), lambda: bus.map("m", create=False)):
            code, text = code_of(call)
            assert (code, "--damaged" in text) == ("journal_damaged", True)
        assert refused_insert(endpoint) == ("journal_damaged", 1), "its number is not used up"
        code, text = code_of(lambda: bus.fork("hall", "m"))
        assert (code, "`factorbus drop m --damaged` gives it up" in text) == ("map_exists", True)

        assert code_of(lambda: bus.drop("hall", damaged=True))[0] == "not_damaged"
        assert code_of(lambda: bus.drop("nowhere", damaged=True))[0] == "unknown_map"
        assert code_of(lambda: bus.drop("m", damaged=True, revision=3))[0] == "bad_message"
        ran = factorbus("drop", "m", "--damaged", "--connect", endpoint)
        assert (ran.returncode, ran.stdout) == (0, "m is gone\n"), ran.stderr
        assert [row.name for row in bus.maps()] == ["hall"]
        assert not (tmp_path / "journal" / "m").exists()
        assert look_at(endpoint, "")[0].state == "ok"
        assert bus.fork("hall", "m").revision == 5, "the name is free again"
        assert {row.name: row.state for row in bus.maps()} == {"hall": "open", "m": "open"}


def spoil(folder: Path, how: str) -> None:
    """What a disk may do to the files of a map."""
    database = folder / NAME
    if how == "gone":
        database.unlink()
    elif how == "log":
        log = database.with_name(f"{NAME}-wal")
        content = bytearray(log.read_bytes())
        content[len(content) // 3] ^= 1
        log.write_bytes(content)
    elif how == "page":
        with database.open("r+b") as file:
            file.seek(4096)
            file.write(bytes(4096))
    else:
        with sqlite3.connect(database) as connection:
            connection.execute("DELETE FROM epoch")
        connection.close()


HOWS = {"gone": signal.SIGKILL, "log": signal.SIGKILL, "page": signal.SIGTERM, "rows": signal.SIGTERM}


@pytest.mark.parametrize("how", HOWS)
def test_whatever_a_disk_did_to_one_map_is_told_and_the_others_work(
    services: Callable[..., Services], tmp_path: Path, how: str
) -> None:
    service = services(tmp_path / "journal")
    with connect(service.start(), client="before", timeout_s=60) as bus:
        for name in ("m", "hall"):
            fill(bus, name, 30)
    service.end(HOWS[how])
    spoil(tmp_path / "journal" / "m", how)
    checked = factorbus("journal", "check", "--journal", str(tmp_path / "journal"))
    assert (checked.returncode, checked.stderr) == (1, "")
    hall, m = checked.stdout.split("m: NOT SOUND\n")
    assert hall == "hall: sound\n"
    assert m.startswith("  ")
    with connect(service.start(), client="after", timeout_s=60) as bus:
        hall, m = bus.maps()
        assert (hall.name, hall.state) == ("hall", "open")
        assert hall.revision >= 30, "further steps may have come of themselves"
        assert (m.name, m.state) == ("m", "damaged")
        with bus.map("hall", mirror=False) as joined:
            added = joined.insert(drafts(31)[30]).revision
        bus.drop("m", damaged=True)
        assert not (tmp_path / "journal" / "m").exists()
        assert bus.fork("hall", "m").revision >= added


def test_a_form_that_is_not_ours_is_another_state(services: Callable[..., Services], tmp_path: Path) -> None:
    service = services(tmp_path / "journal")
    with connect(service.start(), client="before", timeout_s=60) as bus:
        fill(bus, "m", 2)
    service.end(signal.SIGTERM)
    with sqlite3.connect(tmp_path / "journal" / "m" / NAME) as database:
        database.execute("PRAGMA user_version = 99")
    database.close()
    endpoint = service.start()
    assert refused_insert(endpoint) == ("journal_version", 1), "its number is not used up"
    with connect(endpoint, client="after", timeout_s=60) as bus:
        (row,) = bus.maps()
        assert (row.name, row.state) == ("m", "other_version")
        bus.drop("m", damaged=True)
        assert bus.maps() == []
        fill(bus, "m", 2)


def test_the_message_says_what_is_wrong_with_itself(endpoint: str) -> None:
    with bare(endpoint) as client:
        for asked in ({"map": "m", "damaged": 1}, {"map": "m", "damaged": "yes"}):
            came = client.ask(keys.admin_key("drop"), codec.encode_map(asked))
            assert isinstance(came, Refused)
            assert (came.code, came.detail["where"]) == ("bad_message", "drop.damaged")
            assert json.dumps(asked["damaged"]).strip('"') in came.message.replace("'", "")
