"""A map that comes to the disk of a service at work, as `factorbus import` puts it there: it is as any other map."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bare import bare
from journalled import Services, drafts

from factorbus.client import Problem, Refused, connect
from factorbus.client.bus import Bus
from factorbus.journal.bundle import export_map, import_map
from factorbus.journal.store import NAME
from factorbus.proto import codec, keys

COUNT = 5


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    return tmp_path / "journal"


@pytest.fixture
def at(services: Callable[..., Services], journal: Path) -> str:
    """Where a service answers that has the maps of `journal`."""
    return services(journal).start()


@pytest.fixture
def bus(at: str, journal: Path) -> Iterator[Bus]:
    """There is a map `town`, and beside the journal the exported `town.fbmap`."""
    with connect(at, client="operator", timeout_s=60) as connected:
        with connected.map("town", "inc-l", mirror=False) as town:
            for batch in drafts(COUNT):
                town.insert(batch)
        export_map(journal / "town", journal.parent / "town.fbmap")
        yield connected


def bring(journal: Path, name: str) -> None:
    import_map(journal.parent / "town.fbmap", journal / name)


def names(bus: Bus) -> set[str]:
    return {row.name for row in bus.maps()} - {"m"}


def join(bus: Bus) -> None:
    with bus.map("moved", create=False) as moved:
        assert moved.estimate.revision == COUNT
        assert moved.insert(drafts(COUNT + 1)[-1]).revision == COUNT + 1


def listed(bus: Bus) -> None:
    (row,) = (row for row in bus.maps() if row.name == "moved")
    assert (row.state, row.mode, row.revision) == ("open", "inc-l", COUNT)


def in_stats(bus: Bus) -> None:
    assert {row["name"] for row in bus.stats()[0]["maps"]} >= {"town", "moved"}


def fork(bus: Bus) -> None:
    assert bus.fork("moved", "other").revision == COUNT


def drop(bus: Bus) -> None:
    bus.drop("moved", revision=COUNT)
    assert names(bus) == {"town"}


@pytest.mark.parametrize("use", [join, listed, in_stats, fork, drop], ids=lambda use: use.__name__)
def test_whatever_is_done_first_with_an_imported_map_finds_it(
    bus: Bus, journal: Path, use: Callable[[Bus], None]
) -> None:
    bring(journal, "moved")
    use(bus)


def test_what_was_dropped_does_not_come_back_and_may_be_imported_again(bus: Bus, journal: Path) -> None:
    for _ in range(2):
        bring(journal, "moved")
        bus.drop("moved")
        assert not (journal / "moved").exists()
        with pytest.raises(Problem) as unknown:
            bus.map("moved", create=False)
        assert unknown.value.code == "unknown_map"


def test_one_that_does_not_open_is_listed_as_that_and_can_be_given_up(bus: Bus, journal: Path) -> None:
    for use in (lambda: bus.map("moved", create=False), lambda: bus.drop("moved"), bus.maps, None):
        bring(journal, "moved")
        (journal / "moved" / NAME).write_bytes(b"no database at all")
        if use == bus.maps:
            assert ("moved", "damaged") in {(row.name, row.state) for row in bus.maps()}
        elif use is not None:
            with pytest.raises(Problem) as damaged:
                use()
            assert damaged.value.code == "journal_damaged"
        bus.drop("moved", damaged=True)
        assert names(bus) == {"town"}


def test_a_question_or_an_insert_without_joining_opens_it(at: str, bus: Bus, journal: Path) -> None:
    bring(journal, "asked")
    with bare(at) as client:
        came = client.ask(keys.ask_key("asked", "chi2"), codec.encode_map({}))
        assert isinstance(came, bytes)
        assert codec.decode_map(came)["revision"] == COUNT
    bring(journal, "moved")
    with bare(at) as client:
        came = client.ask(keys.insert_key("moved", "robot"), b"no insert")
        assert isinstance(came, Refused)
        assert came.code != "unknown_map"
    assert names(bus) == {"town", "asked", "moved"}


def test_a_name_that_is_no_name_leads_to_no_folder(at: str, bus: Bus, journal: Path) -> None:
    bring(journal, "moved")
    (journal.parent / NAME).touch()
    with bare(at) as client:
        came = client.ask(f"{keys.PREFIX}/map/../ask/chi2", codec.encode_map({}))
        assert isinstance(came, Refused)
        assert came.code == "unknown_map"
    assert names(bus) == {"town", "moved"}
