"""Who sends inserts: taken apart once, known to Zenoh as long as there is room."""

import threading
from contextlib import closing

import pytest

from factorbus.client import Draft, connect
from factorbus.proto.keys import insert_key
from factorbus.proto.problems import Problem
from factorbus.service.app import Shell
from factorbus.service.bus.senders import Senders
from factorbus.service.bus.zenoh_config import RUNTIME, RUNTIME_VARIABLE
from factorbus.service.bus.zenoh_session import open_service_bus
from factorbus.service.config import Config
from factorbus.service.maps.serial_executor import SerialExecutor


class Declared:
    """What a session has declared, and all that it ever had."""

    def __init__(self) -> None:
        self.now: list[str] = []
        self.ever: list[str] = []

    def declare(self, key: str):
        self.now.append(key)
        self.ever.append(key)
        return lambda: self.now.remove(key)


def settle(control: SerialExecutor) -> None:
    """Return when the control thread is done with what it has."""
    reached = threading.Event()
    control.hand(reached.set)
    assert reached.wait(60)


def remembered(senders: Senders, control: SerialExecutor, *clients: str) -> list[str]:
    """Have `clients` send to one map; their keys."""
    sent = [insert_key("m", client) for client in clients]
    for key in sent:
        senders.remember(key, senders.find(key))
    control.close()
    return sent


def test_a_key_is_taken_apart_and_declared_once():
    control, declared = SerialExecutor("control"), Declared()
    senders = Senders(control, declared.declare)
    key, *_ = remembered(senders, control, "robot", "robot", "robot")
    assert senders.find(key) == ("m", "robot")
    assert declared.ever == [key]


def test_who_only_asked_is_not_declared():
    control, declared = SerialExecutor("control"), Declared()
    senders = Senders(control, declared.declare)
    assert senders.find(insert_key("m", "robot")) == ("m", "robot")
    control.close()
    assert not declared.ever


@pytest.mark.parametrize("key", ["factorbus/v1/map/*/in/robot", "factorbus/v1/map/m/in/**"])
def test_a_key_of_nobody_is_refused(key: str):
    control = SerialExecutor("control")
    senders = Senders(control, Declared().declare)
    with pytest.raises(Problem) as caught:
        senders.find(key)
    assert caught.value.code == "bad_name"
    control.close()


def test_the_oldest_makes_room():
    control, declared = SerialExecutor("control"), Declared()
    senders = Senders(control, declared.declare, most=2)
    a, b, c, again = remembered(senders, control, "a", "b", "c", "b")
    assert again == b
    assert declared.now == [b, c]
    assert senders.find(a) == ("m", "a"), "it is taken apart anew"


def test_who_made_room_can_come_back():
    control, declared = SerialExecutor("control"), Declared()
    senders = Senders(control, declared.declare, most=1)
    a, b = insert_key("m", "a"), insert_key("m", "b")
    for key in (a, b):
        senders.remember(key, senders.find(key))
    settle(control)
    assert declared.now == [b]
    senders.remember(a, senders.find(a))
    control.close()
    assert declared.now == [a]


def test_who_sent_to_a_map_that_was_dropped_is_forgotten_and_nobody_else():
    """Their keys took 4 kB each of a service whose maps come and go, until 4096 of them were known."""
    control, declared = SerialExecutor("control"), Declared()
    senders = Senders(control, declared.declare)
    gone = [insert_key("m", client) for client in ("a", "b")]
    other, again = insert_key("m2", "a"), gone[0]
    for key in (*gone, other):
        senders.remember(key, senders.find(key))
    control.hand(senders.forget, "m")
    settle(control)
    assert declared.now == [other]
    senders.remember(again, senders.find(again))
    control.close()
    assert declared.now == [other, again], "a map of that name may come again"


def test_a_service_forgets_them_with_their_map(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(RUNTIME_VARIABLE, RUNTIME)  # which it would set
    config = Config(listen=("tcp/127.0.0.1:0",), warm=False)
    with (
        closing(open_service_bus(config)) as bus,
        closing(Shell(bus, config)) as shell,
        connect(bus.endpoints()[0], client="robot", timeout_s=60) as robot,
    ):
        for name in ("m", "other"):
            robot.map(name, mirror=False).insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        settle(shell._control)
        assert {key.split("/")[3] for key in shell._senders._forget} == {"m", "other"}
        robot.drop("m")
        settle(shell._control)
        assert [key.split("/")[3] for key in shell._senders._forget] == ["other"]
        assert not any("/map/m/" in key for key in shell._senders._found)
