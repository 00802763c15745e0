"""Maps named at the start of a service are made where clients' are, which may ask for the same ones meanwhile."""

import threading
from typing import Any

import pytest

from factorbus.proto.problems import UnknownMap
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.questions.admin import MadeAs
from factorbus.service.registry import Maps


class Made(Maps):
    """Only what making a map needs."""

    def __init__(self, control: SerialExecutor) -> None:
        self._control, self._unopened = control, {"damaged": UnknownMap("damaged")}
        self.made: list[tuple[str, str]] = []

    def create(self, name: str, asked: MadeAs = MadeAs()) -> dict[str, Any]:  # noqa: B008
        self.made.append((name, threading.current_thread().name))
        if name == "bad":
            raise UnknownMap(name)
        return {}


def test_one_after_the_other_with_what_clients_ask_for() -> None:
    control = SerialExecutor("control")
    maps, begun, goes_on = Made(control), threading.Event(), threading.Event()

    def asked() -> None:
        begun.set()
        assert goes_on.wait(60)
        maps.create("hall")

    control.hand(asked)
    assert begun.wait(60)
    threading.Timer(0.05, goes_on.set).start()
    maps.create_all(["yard", "damaged"])
    assert maps.made == [("hall", "control"), ("yard", "control")]
    with pytest.raises(UnknownMap):
        maps.create_all(["bad", "never"])
    assert maps.made[-1][0] == "bad"
    control.close()
