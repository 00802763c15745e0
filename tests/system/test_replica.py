"""A replica on a robot: the link is cut, slow or lossy, either end is killed; nothing is lost, nothing twice."""

import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from journalled import PATIENCE_S, Services, Stream, drafts, rows
from processes import Process
from replicas import MAP, Link, check_equal, drive_with_cuts, replica_settings, upstream_row, wait_until_level
from wire import CLIENT, SERVICE, Wire

from factorbus.client import Draft, connect
from factorbus.journal.problems import NoJournal
from factorbus.journal.store import open_store

STREAMER = str(Path(__file__).parent.parent / "streamer.py")
SIGMAS = (0.1, 0.1, 0.05)


class Pair:
    """Both services, and the link."""

    def __init__(self, services: Callable[..., Services], folder: Path) -> None:
        self.base_folder, self.robot_folder = folder / "base", folder / "robot"
        self.base = services(self.base_folder, 'name="base"')
        self.base_endpoint = self.base.start()
        self.link = Link(self.base_endpoint)
        self.robot = services(self.robot_folder, *replica_settings(self.link))
        self.robot_endpoint = self.robot.start()

    def end(self) -> None:
        self.robot.end(signal.SIGTERM)
        self.base.end(signal.SIGTERM)


@pytest.fixture
def pair(services: Callable[..., Services], tmp_path: Path) -> Iterator[Pair]:
    made = Pair(services, tmp_path)
    yield made
    made.link.relay.close()


def test_cuts_while_a_robot_drives(pair: Pair) -> None:
    poses = 300
    figures = drive_with_cuts(pair.robot_endpoint, pair.base_endpoint, pair.link, poses, 6, (0.2, 1.5), 50.0)
    pair.end()
    size = check_equal(pair.base_folder, pair.robot_folder, poses)
    print(f"{figures}; {size} bytes of inserts")
    assert figures["carried_bytes"] <= 1.2 * size


def test_both_ends_are_killed_meanwhile(pair: Pair) -> None:
    poses = 240
    with connect(pair.robot_endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
        driven = bus.map(MAP, window=32)
        stream = Stream(driven, drafts(poses))
        stream.start()
        stream.allow(60)
        stream.wait_for(60)
        pair.link.relay.hold()
        stream.allow(60)
        stream.wait_for(100)
        pair.robot.end(signal.SIGKILL)  # with inserts that upstream does not have
        pair.robot.start()
        stream.wait_for(120)
        pair.link.relay.break_all()
        pair.link.relay.release()
        stream.allow(60)
        stream.wait_for(150)
        pair.base.end(signal.SIGKILL)
        stream.wait_for(180)
        pair.base.start()
        stream.allow(60)
        stream.wait_for(poses)
        assert not stream.fault
        with connect(pair.base_endpoint, timeout_s=PATIENCE_S) as other:
            wait_until_level(driven, other.map(MAP), poses)
    pair.end()
    check_equal(pair.base_folder, pair.robot_folder, poses)


def test_it_follows_what_others_write_upstream(pair: Pair) -> None:
    with (
        connect(pair.robot_endpoint, client="robot", timeout_s=PATIENCE_S) as bus,
        connect(pair.base_endpoint, client="tablet", timeout_s=PATIENCE_S) as other,
    ):
        driven, at_base = bus.map(MAP), other.map(MAP)
        for n in range(30):
            if n == 10:
                pair.link.relay.hold()
            for letter, each in (("x", driven), ("y", at_base)):
                draft = Draft().se2(f"{letter}{n}", (0, 0, 0) if n == 0 else None, fixed=n == 0)
                if n:
                    draft.between_se2(f"{letter}{n - 1}", f"{letter}{n}", (1, 0, 0.1), sigmas=SIGMAS)
                each.insert(draft)
        pair.link.relay.break_all()
        pair.link.relay.release()
        wait_until_level(driven, at_base, 60)
        assert upstream_row(driven)["rebased"] >= 1
        driven.wait_converged(PATIENCE_S)
        assert rows(driven.ask_estimate().variables) == rows(at_base.ask_estimate().variables)
        end = time.monotonic() + PATIENCE_S
        while driven.estimate.stale or "y29" not in driven.estimate:
            assert time.monotonic() < end, "who follows the replica sees what came from upstream"
            time.sleep(0.02)  # a mirror tells callbacks, not the test
        row = upstream_row(driven)
        assert (row["same_bits"], row["refused"], row["code"]) == (True, 0, "")


def test_loss_and_delay_between_two_namespaces(spawn: Callable[..., Process], tmp_path: Path) -> None:
    wire, poses = Wire(), 300
    try:
        listen = ("-m", "factorbus.service", "--insecure", "--listen")
        base = spawn(
            *wire.run("service"), *listen, f"tcp/{SERVICE}:7447", "--journal", str(tmp_path / "base"), "--name", "base"
        )
        base.ready()
        robot = spawn(
            *wire.run("client"), *listen, f"tcp/{CLIENT}:7448", "--journal", str(tmp_path / "robot"),
            "--name", "robot1", "--upstream", f"tcp/{SERVICE}:7447",
        )  # fmt: skip
        robot.ready()
        client = spawn(*wire.run("client"), STREAMER, f"tcp/{CLIENT}:7448", MAP, str(poses))
        client.line("ready")
        wire.loss, wire.delay_s, wire.jitter_s = 0.05, 0.02, 0.03
        client.tell("more 200")
        client.line("answered")
        wire.cut = True
        client.tell("more 100")
        client.line("answered")
        time.sleep(4.0)  # longer than the lease
        wire.cut = False
        client.tell("end")
        client.line("done")
        end = time.monotonic() + PATIENCE_S
        while len({_last(tmp_path / name) for name in ("base", "robot")}) > 1:
            assert time.monotonic() < end, [_last(tmp_path / name) for name in ("base", "robot")]
            time.sleep(0.2)  # a file tells nobody that it has grown
        for each in (robot, base):
            each.signal(signal.SIGTERM)
            assert each.wait() == 0
        check_equal(tmp_path / "base", tmp_path / "robot", poses)
    finally:
        wire.close()


def _last(folder: Path) -> tuple[int, bytes]:
    """The number and the digest of the last record of a journal; 0 where the link has not brought the map yet."""
    try:
        store = open_store(folder / MAP, read_only=True)
    except NoJournal:
        return 0, b""
    try:
        return store.last()[::2]
    finally:
        store.close()
