"""A service that tests loop closures: what a robot, an operator and a viewer see; killed, forked and followed."""

import json
import queue
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh
from false_closures import DriveWithFalse, drive_with_false
from journalled import Services, Stream
from processes import PATIENCE_S
from replicas import Link, replica_settings, upstream_row, wait_until_level
from tested_service import ran, told, values

from factorbus.client import Changes, Draft, Refused, connect
from factorbus.journal.store import open_store
from factorbus.proto import keys
from factorbus.proto.own_clients import JUDGE

POSES = 260


@pytest.fixture(scope="module")
def drive() -> DriveWithFalse:
    """Of these seeds both right and false closures come."""
    return drive_with_false(POSES, 2, 0.4, "random")


def events_of(endpoint: str, name: str) -> tuple[zenoh.Session, "queue.SimpleQueue[dict[str, Any]]"]:
    """What is published on out/event of a map."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    session, came = zenoh.open(config), queue.SimpleQueue[dict[str, Any]]()

    def take(sample: Any) -> None:
        came.put(msgpack.unpackb(sample.payload.to_bytes()))

    session.declare_subscriber(keys.event_key(name), zenoh.handlers.Callback(take, indirect=False))
    return session, came


def test_a_drive_with_false_closures(services: Callable[..., Services], tmp_path: Path, drive: DriveWithFalse) -> None:
    running = services(tmp_path / "journal", 'closures="test"', "checkpoint_s=0.1")
    endpoint = running.start()
    session, events = events_of(endpoint, "yard")
    at = ("--connect", endpoint, "--json")
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("yard") as joined:
        accepted = [joined.insert(batch) for batch in drive.batches]
        came = sum(each.report.get("closures", 0) for each in accepted)
        assert came == drive.is_false().size
        found = joined.suspects(every=True)
        is_in = np.array([state == "accepted" for state in found.states])
        assert not (is_in & drive.is_false()).any()
        assert is_in.sum() > 10
        assert sum(each.report.get("suspects", 0) for each in accepted) >= (~is_in).sum()
        assert joined.stats()["closure_states"] == found.counts
        assert (joined.stats()["closures"], {*joined.stats()["clients"]}) == ("test", {joined.client})

        listed = json.loads(ran("ask", "suspects", "yard", *at))
        out = [row["factor"] for row in listed["listed"]]
        assert out == found.factors[~is_in].tolist()
        assert listed["listed"][0]["reason"] in ("unsure", "improbable")
        text = ran("ask", "suspects", "yard", "--connect", endpoint)
        assert f"{out[0]} " in text
        assert "chance" in text
        first_in = int(found.factors[is_in][0])
        ran("change", "accept", "yard", str(out[0]), *at)
        ran("change", "reject", "yard", str(first_in), *at)
        refused = json.loads(ran("change", "reject", "yard", "0", *at, code=5))
        assert refused["problem"]["code"] == "not_a_closure"
        with pytest.raises(Refused, match="one of the map's suspects, which the estimate does not have") as unknown:
            joined.uncertainty.why(factor=first_in)
        assert unknown.value.code == "unknown_factor"
        said = {out[0]: ("restored", "user"), first_in: ("rejected", "user")}
        for n in range(4):
            last = POSES + n
            key = f"x{last}"
            joined.insert(Draft().se2(key).between_se2(f"x{last - 1}", key, (1, 0, 0), sigmas=(0.1, 0.1, 0.02)))
            joined.insert(Draft().between_se2(f"x{last - 2}", key, (2, 0, 0), sigmas=(0.1, 0.1, 0.05)))
        before = told(joined)
        assert before | said == before
        moved = [event for event in iter_until(events, out[0], "restored") if event["event"] == "closures"]
        assert {"factors", "states", "reasons", "epoch", "revision"} <= moved[0].keys()

        fork = bus.fork("yard", "what-if")
        assert fork.closures == "test"
        with bus.map("what-if", create=False) as other:
            assert told(other) == before
            other.change(Changes().accept(first_in))
            assert told(other)[first_in] == ("restored", "user")
            other.insert(Draft().between_se2("x5", "x9", (9, 9, 0), sigmas=(0.1, 0.1, 0.05)))
            assert len(told(other)) == len(before) + 1
        joined.wait_converged(PATIENCE_S)
        before, held = told(joined), values(joined)
        session.close()
        running.end(signal.SIGKILL)
        running.start()
        with bus.map("yard", create=False) as again:
            assert (told(again), values(again)) == (before, held)
            assert told(again)[first_in] == ("rejected", "user")
    running.end(signal.SIGTERM)
    verified = ran("journal", "verify", "--journal", str(tmp_path / "journal"))
    assert {"what-if", "yard"} <= {line.partition(":")[0] for line in verified.splitlines() if "to the bit" in line}
    assert ran("journal", "check", "--journal", str(tmp_path / "journal")).count(": sound") == 3


def iter_until(events: "queue.SimpleQueue[dict[str, Any]]", factor: int, state: str) -> list[dict[str, Any]]:
    """Up to the event of that factor and state."""
    seen: list[dict[str, Any]] = []
    while True:
        seen.append(events.get(timeout=PATIENCE_S))
        if (factor, state) in zip(seen[-1].get("factors", ()), seen[-1].get("states", ()), strict=True):
            return seen


def test_a_suspect_that_goes_with_its_pose_is_told(services: Callable[..., Services], tmp_path: Path) -> None:
    running = services(tmp_path / "journal", 'closures="test"')
    endpoint = running.start()
    session, events = events_of(endpoint, "yard")
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("yard") as joined:
        joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        for n in range(1, 30):
            joined.insert(Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0), sigmas=(0.1, 0.1, 0.02)))
        for n in (20, 25):
            joined.insert(Draft().between_se2("x2", f"x{n}", (0, 5, 1), sigmas=(0.1, 0.1, 0.05)))
        first, second = joined.suspects().factors.tolist()
        joined.change(Changes().marginalize("x20"))
        seen = iter_until(events, first, "gone")
        assert (seen[-1]["factors"], seen[-1]["reasons"]) == ([first], ["pose_gone"])
        joined.change(Changes().remove_factors([second]))
        assert iter_until(events, second, "gone")[-1]["reasons"] == ["removed"]
        assert joined.stats()["closure_states"]["suspect"] == joined.suspects().factors.size == 0
    session.close()


def test_killed_again_and_again_nothing_is_lost_or_done_twice(
    services: Callable[..., Services], tmp_path: Path, drive: DriveWithFalse
) -> None:
    running = services(tmp_path / "journal", 'closures="test"', "checkpoint_s=0.05")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m") as driven:
        stream = Stream(driven, drive.batches)
        stream.start()
        for kill in range(4):
            stream.allow(POSES // 5)
            stream.wait_for((kill + 1) * (POSES // 5) - 20)
            running.end(signal.SIGKILL)
            running.start()
        stream.allow(POSES)
        stream.wait_for(POSES)
        assert not stream.fault
        driven.wait_converged(PATIENCE_S)
        assert driven.stats()["variables"] == POSES
        before = told(driven), values(driven)
        is_in = np.array([state == "accepted" for state, _ in before[0].values()])
        assert is_in.size == drive.is_false().size
        assert not (is_in & drive.is_false()).any()
    running.end(signal.SIGTERM)
    store = open_store(tmp_path / "journal" / "m", read_only=True)
    entries = [(entry.client == JUDGE, entry.sequence) for record in store.records() for entry in record.entries]
    assert list(store.check()) == []
    store.close()
    assert [n for judged, n in entries if not judged] == list(range(1, POSES + 1))
    verified = ran("journal", "verify", "--journal", str(tmp_path / "journal"), "m")
    assert "all the same to the bit" in verified


@pytest.mark.parametrize("policy", ["test", "robust"])
def test_a_replica_has_the_verdicts_of_upstream_and_upstream_those_of_the_replica(
    services: Callable[..., Services], tmp_path: Path, drive: DriveWithFalse, policy: str
) -> None:
    base = services(tmp_path / "base", 'name="base"', f'closures="{policy}"')
    link = Link(base.start())
    robot = services(tmp_path / "robot", *replica_settings(link), f'closures="{policy}"')
    name, half = json.loads(replica_settings(link)[2].partition("=")[2])[0], POSES // 2
    with (
        connect(robot.start(), client="robot", timeout_s=PATIENCE_S) as bus,
        connect(base._endpoint, client="desk", timeout_s=PATIENCE_S) as other,
    ):
        driven = bus.map(name)
        for batch in drive.batches[:half]:
            driven.insert(batch)
        base.eventually(lambda: upstream_row(driven), lambda row: bool(row["connected"]) and row["behind"] == 0)
        at_base = other.map(name)
        assert other.maps()[0].closures == policy
        for batch in drive.batches[half:]:
            at_base.insert(batch)
        out = at_base.suspects().factors.tolist()
        at_base.change(Changes().accept(out[0]))
        at_base.wait_converged(PATIENCE_S)
        wait_until_level(driven, at_base, POSES)
        assert told(driven) == told(at_base)
        assert values(driven) == values(at_base)
        assert told(driven)[out[0]] == ("restored", "user")
    robot.end(signal.SIGTERM)
    base.end(signal.SIGTERM)
    link.relay.close()
    stores = [open_store(tmp_path / end / name, read_only=True) for end in ("base", "robot")]
    lasts = [store.last() for store in stores]
    for store in stores:
        store.close()
    assert lasts[0] == lasts[1], "the chain is a digest of every value there ever was"


def test_a_map_keeps_its_policy(services: Callable[..., Services], tmp_path: Path) -> None:
    running = services(tmp_path / "journal")
    with connect(running.start(), timeout_s=PATIENCE_S) as bus:
        assert bus.create("plain").closures == "trust"
        assert bus.create("tested", closures="test").closures == "test"
        for name, asked in (("plain", "test"), ("tested", "trust")):
            with pytest.raises(Refused, match="policy") as refused:
                bus.create(name, closures=asked)
            assert refused.value.code == "other_closures"
        assert bus.create("tested").closures == "test"
        with bus.map("plain") as plain:
            assert (plain.suspects().policy, plain.suspects().factors.size) == ("trust", 0)
            step = Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1")
            plain.insert(step.between_se2("x0", "x1", (1, 0, 0), sigmas=(0.1, 0.1, 0.1)))
            with pytest.raises(Refused) as refused:
                plain.change(Changes().reject(0))
            assert refused.value.code == "not_a_closure"
        running.end(signal.SIGKILL)
        running.start()
        kept = {row.name: row.closures for row in bus.maps()}
        assert (kept["plain"], kept["tested"]) == ("trust", "test")
    running.end(signal.SIGTERM)
