"""A street that is driven day after day, in a map that keeps some poses: over the bus, killed, and followed."""

import queue
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from bare import bare
from journalled import Services, rows
from processes import PATIENCE_S
from replicas import MAP, Link, replica_settings
from zenoh.handlers import Callback

from factorbus.client import Map, Refused, connect
from factorbus.journal.store import open_store
from factorbus.proto import codec, keys
from factorbus.proto.keep import keep_text
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.own_clients import KEEPER
from factorbus.proto.problems import BadOption
from factorbus.service.config import Limits
from factorbus.service.journal.library import make_map_solver
from factorbus.service.journal.recovery import verify
from factorbus.service.questions.answers import Question

LENGTH, KEEP = 100, {"per_area": 2.5, "window": 5}
WEIGHT = np.diag([400.0, 400.0, 900.0])[np.triu_indices(3)]


def key(day: int, k: int) -> int:
    return (ord("a") + day) << 56 | k


def driven(day: int, there: set[int]) -> list[Batch]:
    """A metre a pose, with a closure to each pose of other days at the same place that is there; the first is fixed."""
    rng, batches = np.random.default_rng(day), list[Batch]()
    for k in range(LENGTH):
        pairs = [(key(day, k - 1), [1.0, 0.0, 0.0])] if k else []
        if k < LENGTH - 5:  # the newest of a day go when another one has left it behind
            pairs += [(key(other, k), [0.0, 0.0, 0.0]) for other in range(day) if key(other, k) in there]
        first = day == k == 0
        new = Variables("se2", np.array([key(day, k)]), np.zeros((1, 3)) if first else None, first)
        ends = np.array([(one, key(day, k)) for one, _ in pairs], np.int64).reshape(-1, 2)
        z = np.array([z for _, z in pairs]).reshape(-1, 3) + rng.normal(0.0, 0.01, (len(pairs), 3))
        factors = Factors("between_se2", ends, z, np.tile(WEIGHT, (len(pairs), 1)))
        batches.append(Batch((new,), (factors,) if pairs else ()))
    return batches


def poses_of(joined: Map) -> set[int]:
    return {int(each) for group in joined.ask_estimate().variables for each in group.keys}


def drive(joined: Map, day: int) -> None:
    for batch in driven(day, poses_of(joined) if day else set()):
        joined.insert(batch)


def wait_kept(services: Services, joined: Map) -> dict[str, Any]:
    """Until the map has looked, nothing more goes, and it is at its optimum."""
    return services.eventually(joined.stats, lambda seen: not seen["kept"]["pending"] and not seen["converging"])


def replayed(folder: Path) -> tuple[dict[int, tuple[bytes, int]], int]:
    """The values that a journal leads to, every record of which has the same bits again; how many are the map's own."""
    store = open_store(folder, read_only=True)
    try:
        header = store.header()
        map_solver = make_map_solver(header.mode, header.options, header.epoch, Limits())
        assert all(same for _, same in verify(store, map_solver))
        own = sum(entry.client == KEEPER for record in store.records() for entry in record.entries)
        return rows(map_solver.snapshot([Question("estimate")]).variables), own
    finally:
        store.close()


def test_how_a_map_is_made_that_keeps_some_poses(services: Callable[..., Services], tmp_path: Path) -> None:
    running = services(tmp_path / "j", 'keep="per_area=3"')
    endpoint = running.start()
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
        row = bus.create("street", keep=KEEP)
        assert row.keep == "per_area=2.5:1,window=5,landmarks=2,loss=1"
        assert bus.create("street", keep={"window": 5, "per_area": [2.5, 1]}).keep == row.keep
        assert bus.create("street").keep == row.keep, "whichever it has"
        assert bus.create("new").keep == "per_area=3:1,window=50,landmarks=2,loss=1"
        assert bus.create("every", keep="all").keep == "all"
        assert "kept" not in bus.map("every").stats()
        with pytest.raises(Refused) as refused:
            bus.create("street", keep="all")
        assert refused.value.code == "other_keep"
        bus.fork("street", "copy")
        assert {each.name: each.keep for each in bus.maps()}["copy"] == row.keep
        for wrong in ("", "window=5", "per_area=0", "per_area=2:0", "per_area=2,window=x", "per_area=2,per_area=3"):
            with pytest.raises(BadOption, match="keep"):
                bus.create("wrong", keep=wrong)
        with bare(endpoint) as client:
            asked = codec.encode_map({"map": "wrong", "keep": "window=5"})
            answer = client.ask(keys.admin_key("create"), asked)
            assert isinstance(answer, Refused)
            assert answer.code == "bad_option"


@pytest.mark.timeout(600)
def test_its_size_follows_the_street_and_not_the_days(services: Callable[..., Services], tmp_path: Path) -> None:
    running, events = services(tmp_path / "j"), queue.SimpleQueue[dict[str, Any]]()
    endpoint = running.start()

    def hear(sample: zenoh.Sample) -> None:
        events.put(codec.decode_map(sample.payload.to_bytes()))

    with bare(endpoint) as client, connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
        client.session.declare_subscriber(keys.event_key("street"), Callback(hear, indirect=False))
        bus.create("street", keep=KEEP)
        with bus.map("street") as joined, bus.map("street", client="viewer") as viewer:
            stats, sizes = dict[str, Any](), list[int]()
            for day in range(3):
                drive(joined, day)
                stats = wait_kept(running, joined)
                sizes.append(stats["variables"])
            assert sizes[0] < LENGTH / 2
            assert sizes[2] <= 1.2 * sizes[0]
            there = poses_of(joined)
            assert key(0, 0) in there, "it is fixed"
            assert {key(2, k) for k in range(LENGTH - 5, LENGTH)} <= there, "the newest"
            assert stats["kept"]["removed_poses"] == 3 * LENGTH - stats["variables"]
            assert stats["inserts"]["accepted"] == 3 * LENGTH
            assert KEEPER not in stats["clients"]
            told = list[dict[str, Any]]()
            while sum(each["poses"] for each in told) < stats["kept"]["removed_poses"]:
                event = events.get(timeout=PATIENCE_S)
                told += [event] if event["event"] == "kept" else []
            assert sum(each["loss"] for each in told) == pytest.approx(stats["kept"]["loss"])
            running.eventually(lambda: set(viewer.estimate.columns("se2")[0].tolist()), lambda seen: seen == there)
            estimate = joined.ask_estimate()
            running.end(signal.SIGKILL)
            running.start()
            assert rows(joined.ask_estimate().variables) == rows(estimate.variables)
            drive(joined, 3)
            wait_kept(running, joined)
            estimate = joined.ask_estimate()
    running.end(signal.SIGTERM)
    values, own = replayed(tmp_path / "j" / "street")
    assert values == rows(estimate.variables)
    assert own >= 4


def test_a_replica_asks_its_upstream_for_the_same_policy(services: Callable[..., Services], tmp_path: Path) -> None:
    base = services(tmp_path / "base")
    link = Link(base.start())
    robot = services(tmp_path / "robot", *replica_settings(link, 'keep="per_area=2.5,window=5"'))
    with (
        connect(link.endpoint, client="watcher", timeout_s=PATIENCE_S) as far,
        connect(robot.start(), client="robot", timeout_s=PATIENCE_S) as near,
        near.map(MAP) as driven_here,
    ):
        wanted = keep_text(KEEP)
        base.eventually(lambda: {row.name: row.keep for row in far.maps()}, lambda seen: seen.get(MAP) == wanted)
        far.create("all", keep="all")
        with near.map("all") as alone:
            robot.eventually(lambda: alone.stats().get("upstream", {}).get("code"), lambda seen: seen == "other_keep")
        drive(driven_here, 0)
        robot.eventually(lambda: len(poses_of(driven_here)), lambda seen: seen < LENGTH / 2)
        assert not driven_here.stats()["kept"]["pending"], "upstream looks, not the replica"
    link.relay.close()


@pytest.mark.timeout(600)
def test_a_replica_has_what_its_upstream_keeps(services: Callable[..., Services], tmp_path: Path) -> None:
    base = services(tmp_path / "base")
    endpoint = base.start()
    link = Link(endpoint)
    with connect(endpoint, client="watcher", timeout_s=PATIENCE_S) as far:
        far.create(MAP, keep=KEEP)
        robot = services(tmp_path / "robot", *replica_settings(link))
        with (
            connect(robot.start(), client="robot", timeout_s=PATIENCE_S) as near,
            near.map(MAP) as driven_here,
            far.map(MAP) as at_base,
        ):
            drive(driven_here, 0)
            base.eventually(lambda: poses_of(at_base), lambda seen: key(0, LENGTH - 1) in seen)
            wait_kept(base, at_base)
            there = poses_of(at_base)
            assert len(there) < LENGTH / 2
            robot.eventually(lambda: poses_of(driven_here), lambda seen: seen == there)
        robot.end(signal.SIGTERM)
    link.relay.close()
    base.end(signal.SIGTERM)
    values, own = replayed(tmp_path / "robot" / MAP)
    assert set(values) == there
    assert own > 0
