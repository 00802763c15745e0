"""More ends than two: replicas of replicas, several of one upstream, an upstream that is another one than before."""

import signal
from collections.abc import Callable
from pathlib import Path

from journalled import PATIENCE_S, Services
from replicas import MAP, upstream_row, wait_until_level

from factorbus.client import Draft, connect
from factorbus.client.map import Map
from factorbus.journal.store import open_store

SIGMAS = (0.1, 0.1, 0.05)
Start = Callable[..., Services]


def drive(driven: Map, letter: str, first: int, count: int) -> None:
    for n in range(first, first + count):
        draft = Draft().se2(f"{letter}{n}", (0, 0, 0) if n == 0 else None, fixed=n == 0)
        if n:
            draft.between_se2(f"{letter}{n - 1}", f"{letter}{n}", (1, 0, 0.1), sigmas=SIGMAS)
        driven.insert(draft)


def follower(services: Start, folder: Path, upstream: str, name: str) -> Services:
    return services(folder, f'upstream="{upstream}"', f'name="{name}"', f'create=["{MAP}"]')


def check_equal(one: Path, other: Path, inserts: int) -> None:
    """Both journals have the same records, values included, and every insert once."""
    lasts, found = [], []
    for folder in (one, other):
        store = open_store(folder / MAP, read_only=True)
        try:
            assert list(store.check()) == []
            lasts.append(store.last())
            found.append([(each.client, each.sequence) for record in store.records() for each in record.entries])
        finally:
            store.close()
    assert lasts[0] == lasts[1], "the chain is a digest of every value there ever was"
    assert found[0] == found[1]
    assert len(found[0]) == len(set(found[0])) == inserts


def test_a_replica_of_a_replica_sends_through_it(services: Start, tmp_path: Path) -> None:
    top = services(tmp_path / "top", 'name="top"')
    at_top = top.start()
    middle = follower(services, tmp_path / "middle", at_top, "middle")
    at_middle = middle.start()
    bottom = follower(services, tmp_path / "bottom", at_middle, "bottom")
    with (
        connect(at_top, client="tablet", timeout_s=PATIENCE_S) as above,
        connect(at_middle, client="looker", timeout_s=PATIENCE_S) as between,
        connect(bottom.start(), client="robot", timeout_s=PATIENCE_S) as below,
    ):
        maps = [bus.map(MAP, mirror=False) for bus in (above, between, below)]
        drive(maps[2], "x", 0, 20)
        wait_until_level(maps[1], maps[0], 20)
        assert upstream_row(maps[1])["behind"] == 0
        drive(maps[0], "y", 0, 5)
        drive(maps[2], "x", 20, 5)
        wait_until_level(maps[1], maps[0], 30)
        wait_until_level(maps[2], maps[1], 30)
        rows = [upstream_row(each) for each in maps[1:]]
        assert [(row["behind"], row["refused"], row["code"]) for row in rows] == [(0, 0, "")] * 2
    for each in (bottom, middle, top):
        each.end(signal.SIGTERM)
    check_equal(tmp_path / "top", tmp_path / "middle", 30)
    check_equal(tmp_path / "middle", tmp_path / "bottom", 30)


def test_two_replicas_of_one_upstream_write_in_turns(services: Start, tmp_path: Path) -> None:
    base = services(tmp_path / "base", 'name="base"')
    where = base.start()
    robots = [follower(services, tmp_path / name, where, name) for name in ("one", "two")]
    with (
        connect(where, timeout_s=PATIENCE_S) as bus,
        connect(robots[0].start(), client="one", timeout_s=PATIENCE_S) as first,
        connect(robots[1].start(), client="two", timeout_s=PATIENCE_S) as second,
    ):
        maps = [each.map(MAP) for each in (bus, first, second)]
        for n in range(30):
            drive(maps[1], "x", n, 1)
            drive(maps[2], "y", n, 1)
        for each in maps[1:]:
            wait_until_level(each, maps[0], 60)
        assert [upstream_row(each)["refused"] for each in maps[1:]] == [0, 0]
        sizes = [(each.graph().batch.factor_count, each.stats()["variables"]) for each in maps]
        assert sizes == [(58, 60)] * 3
    for each in (*robots, base):
        each.end(signal.SIGTERM)
    for name in ("one", "two"):
        check_equal(tmp_path / "base", tmp_path / name, 60)


def test_an_upstream_that_begins_anew_gets_all_that_the_robot_has(services: Start, tmp_path: Path) -> None:
    """Dropped, and then with an empty journal in which somebody else has written."""
    base = services(tmp_path / "base", 'name="base"')
    where = base.start()
    robot = follower(services, tmp_path / "robot", where, "robot1")
    with connect(robot.start(), client="robot", timeout_s=PATIENCE_S) as bus:
        driven = bus.map(MAP)
        with connect(where, timeout_s=PATIENCE_S) as other:
            drive(driven, "x", 0, 10)
            wait_until_level(driven, other.map(MAP), 10)
            other.drop(MAP)
            rows = [10]
            base.eventually(lambda: [row.variables for row in other.maps() if row.name == MAP], rows.__eq__)
        base.end(signal.SIGTERM)
        drive(driven, "x", 10, 5)
        another = services(tmp_path / "another", 'name="base"')
        another.bear(where)
        another.ready()
        with connect(where, client="tablet", timeout_s=PATIENCE_S) as other:
            at_base = other.map(MAP)
            drive(at_base, "y", 0, 3)
            wait_until_level(driven, at_base, 18)
            assert upstream_row(driven)["refused"] == 0
    robot.end(signal.SIGTERM)
    another.end(signal.SIGTERM)
    check_equal(tmp_path / "another", tmp_path / "robot", 18)
