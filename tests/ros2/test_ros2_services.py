"""The services of the bridge, called by a node that is nothing of ours: on a map that is acted, and on a real one."""

import json
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros
import words
import zenoh
from browser import free_port
from processes import Process
from test_ros2_bridge import bridge

from factorbus.client import Draft, Refused, connect
from factorbus.proto.asking import Repaired
from factorbus.proto.messages import Variables
from factorbus.ros2.messages import Messages
from factorbus.ros2.names import read_attachment
from factorbus.ros2.node import open_node
from factorbus.ros2.services import MapServices
from factorbus.ros2.trigger import REQUEST, TRIGGER

SECOND = 10**9
NAMES = ("settle", "save", "fork", "repair", "accept", "reject")


class ActedMap:
    """Does nothing, and says so."""

    name, revision = "yard", 7

    def __init__(self) -> None:
        self.estimate = self
        self.changes: list[Any] = []
        self.false = np.array([3, 5], np.int64)
        self.may_settle = threading.Event()
        self.may_settle.set()

    def settle(self, timeout_s: float) -> Any:
        assert self.may_settle.wait(timeout_s)
        return self

    def chi2(self) -> Any:
        return type("Chi2", (), {"chi2": 12.5})()

    def export(self, form: str, robot: str = "") -> str:
        return f"{form} of {robot or 'all'}\n"

    def repair(self, timeout_s: float) -> Repaired:
        assert timeout_s > 0
        moved = (Variables("se2", np.array([1], np.int64), np.zeros((1, 3))),)
        return Repaired(1, 7, self.false, np.ones(len(self.false)), 9, 100.0, 20.0, 20.0, 0.1, moved)

    def change(self, changes: Any, settle: bool, timeout_s: float) -> Any:
        assert settle
        assert timeout_s > 0
        self.changes.append(changes.listed())
        return self


class ActedBus:
    def __init__(self) -> None:
        self.forks: list[tuple[str, str]] = []

    def fork(self, name: str, target: str) -> Any:
        if self.forks:
            raise Refused("map_exists", f"there is a map {target!r} already", {})
        self.forks.append((name, target))
        return type("Row", (), {"name": target, "revision": 7})()


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[ros.RosNode, ActedMap, ActedBus]]:
    at = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config()
    for path, value in {"mode": "router", "listen/endpoints": [at], "scouting/multicast/enabled": False}.items():
        config.insert_json5(path, json.dumps(value))
    joined, bus = ActedMap(), ActedBus()
    with zenoh.open(config), ros.session(at) as session, open_node(at, 5, "/robot1", "mapper", 10.0, {}) as node:
        services = MapServices(bus, joined, tmp_path / "saved", "a")  # type: ignore[arg-type]
        with services.offer(node, Messages("jazzy")):
            robot = ros.RosNode(session, 5)
            robot.tokens(1 + len(NAMES))
            yield robot, joined, bus


def test_a_call_has_its_answer_with_its_own_number(served: Any) -> None:
    robot, *_ = served
    success, message, (number, stamp, gid) = robot.call("/robot1/mapper/settle")
    assert (success, message) == (True, "settled at revision 7, χ² 12.5")
    assert (number, gid) == (1, robot._gid)
    assert stamp > 10**18
    assert robot.call("/robot1/mapper/settle")[2][0] == 2
    assert robot.call("/robot1/mapper/settle", attached=False)[0], "of one who is no node of ROS, too"


def test_its_tokens_are_those_of_services(served: Any) -> None:
    robot, *_ = served
    found = [token.split("/")[5:] for token in robot.tokens(1 + len(NAMES)) if "/SS/" in token]
    hashed = words.TRIGGER_HASH
    assert sorted(found) == sorted(
        [
            "SS", "%", "%robot1", "mapper", f"%robot1%mapper%{name}", "std_srvs::srv::dds_::Trigger_", hashed,
            "::,10:,:,:,,",
        ]
        for name in NAMES
    )  # fmt: skip


def test_save_fork_and_what_repair_finds(served: Any, tmp_path: Path) -> None:
    robot, joined, bus = served
    folder = tmp_path / "saved"
    success, message, _ = robot.call("/robot1/mapper/save")
    assert (success, message) == (True, f"{folder / 'yard-r7.g2o'} {folder / 'yard-r7.tum'}")
    assert (folder / "yard-r7.tum").read_text() == "tum of a\n"
    assert robot.call("/robot1/mapper/fork")[:2] == (True, "map yard-r7 begins as yard is at revision 7")
    assert bus.forks == [("yard", "yard-r7")]
    assert robot.call("/robot1/mapper/fork")[:2] == (False, "there is a map 'yard-r7' already [map_exists]")
    for name in ("accept", "reject"):
        assert robot.call(f"/robot1/mapper/{name}")[:2] == (False, "nothing is proposed; call repair first")
    success, message, _ = robot.call("/robot1/mapper/repair")
    assert success
    assert message == (
        "2 of 9 loop closures are false (factors 3, 5); the map costs 100, and 20 without: accept or reject"
    )
    assert robot.call("/robot1/mapper/reject")[:2] == (True, "2 factors left in")
    assert not joined.changes
    robot.call("/robot1/mapper/repair")
    assert robot.call("/robot1/mapper/accept")[:2] == (True, "2 factors taken out at revision 7")
    (changes,) = joined.changes
    assert [change.change for change in changes] == ["remove_factors", "place"]
    joined.false = joined.false[:0]
    assert robot.call("/robot1/mapper/repair")[:2] == (True, "none of 9 loop closures is false")
    assert not robot.call("/robot1/mapper/accept")[0]


def test_calls_that_wait_are_answered_in_order_and_too_many_are_told_so(served: Any) -> None:
    robot, joined, _ = served
    joined.may_settle.clear()
    answers: queue.SimpleQueue[tuple[bool, str]] = queue.SimpleQueue()
    threads = [threading.Thread(target=lambda: answers.put(robot.call("/robot1/mapper/settle")[:2])) for _ in range(20)]
    for thread in threads:
        thread.start()
    full = [answers.get(timeout=60) for _ in range(3)]  # one is being answered, and sixteen wait
    assert full == 3 * [(False, "16 calls wait already; call again later")]
    joined.may_settle.set()
    assert all(answers.get(timeout=60)[0] for _ in range(17))
    for thread in threads:
        thread.join()


def test_without_a_folder_nothing_is_saved() -> None:
    services = MapServices(ActedBus(), ActedMap(), None, "x")  # type: ignore[arg-type]
    assert services.answer("save") == (False, "no folder to save into; start the bridge with --save-folder DIR")


def test_a_folder_that_cannot_be_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done, text = MapServices(ActedBus(), ActedMap(), tmp_path / "file", "x").answer("save")  # type: ignore[arg-type]
    assert not done
    assert text.startswith(f"{tmp_path / 'file'}: File exists")


def test_the_definition_is_that_of_the_published_hash() -> None:
    for distribution in ("jazzy", "kilted", "lyrical"):
        assert Messages(distribution).hash(TRIGGER) == words.TRIGGER_HASH
    messages = Messages("humble")
    assert messages.hash(TRIGGER) == "TypeHashNotSupported"
    assert messages.write(REQUEST, messages.type_of(REQUEST)(0)) == bytes(words.TriggerRequest(0).serialize())


def test_an_attachment_of_another_form_is_nobodys() -> None:
    assert read_attachment(b"") == (0, bytes(16))
    assert read_attachment(bytes(32)) == (0, bytes(16))


def test_a_false_closure_goes_by_services_alone(endpoint: str, spawn: Callable[..., Process], tmp_path: Path) -> None:
    """On a real map: a robot drives on while it is repaired, saved and forked."""
    saved = tmp_path / "saved"
    with (
        ros.session(endpoint) as session,
        connect(endpoint, client="looker", timeout_s=60) as bus,
        bus.map("served") as looked,
    ):
        joined = bridge(spawn, endpoint, "served", 21, "--save-folder", str(saved))
        robot = ros.RosNode(session, 21)
        robot.subscribe("/tf", words.TFMessage)
        robot.wait_for_endpoints(8)
        for n in range(1, 31):
            robot.publish("/odom", ros.odometry(n * SECOND, (float(n), 0.0, 0.0), [1e-4] * 6))
        while robot.wait_for("/tf")[0].transforms[0].header.stamp.sec < 30:
            pass
        draft = Draft()
        for first, second in ((0, 20), (2, 22), (4, 24)):
            draft.between_se2(f"x{first}", f"x{second}", (20.0, 0.0, 0.0), sigmas=[0.05] * 3)
        draft.between_se2("x5", "x25", (3.0, 3.0, 1.0), sigmas=[0.05] * 3)
        looked.insert(draft)
        success, message, _ = robot.call("/factorbus/repair")
        assert success
        assert message.startswith("1 of 4 loop closures are false")
        before = looked.chi2().chi2
        success, message, _ = robot.call("/factorbus/accept")
        assert success, message
        assert looked.chi2().chi2 < 0.1 * before
        assert robot.call("/factorbus/settle")[0]
        success, message, _ = robot.call("/factorbus/save")
        assert success, message
        assert len(Path(message.split()[1]).read_text().splitlines()) == 30
        success, message, _ = robot.call("/factorbus/fork")
        assert success, message
        assert message.split()[1] in [row.name for row in bus.maps()]
        robot.publish("/odom", ros.odometry(31 * SECOND, (31.0, 0.0, 0.0), [1e-4] * 6))
        while robot.wait_for("/tf")[0].transforms[0].header.stamp.sec < 31:
            pass
    joined.signal(signal.SIGINT)
    assert joined.wait() == 0
