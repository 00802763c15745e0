"""A service of another major version is told apart from silence; of a service of ours, what it knows is asked first."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zenoh
from faulty.other_version import someone_of
from faulty.service import MAP, Service, endpoint_in, peer

from factorbus.client import Changes, Draft, connect
from factorbus.client.bus import Bus
from factorbus.proto.camera import Camera
from factorbus.proto.problems import NotSupported, OtherProtocol, Unavailable
from factorbus.proto.protocol import known

CAMERA = Camera("pinhole", (400.0, 400.0, 320.0, 240.0))


ASKS: dict[str, Callable[[Bus], object]] = {
    "map": lambda bus: bus.map("m", mirror=False),
    "existing": lambda bus: bus.map("m", create=False),
    "maps": lambda bus: bus.maps(),
    "stats": lambda bus: bus.stats(),
    "drop": lambda bus: bus.drop("m"),
    "features": lambda bus: bus.features(CAMERA).factor(np.zeros(13), np.eye(13), np.zeros((1, 2))),
}


@pytest.mark.parametrize("ask", ASKS)
@pytest.mark.parametrize("version", ["v2", "v0", "v1.1"])
def test_another_version_is_said_and_not_waited_for(tmp_path: Path, ask: str, version: str) -> None:
    for_ever_s = 10 * 60  # in this file a test that waits is ended after a minute
    with someone_of(version, endpoint_in(tmp_path)), connect(endpoint_in(tmp_path), timeout_s=for_ever_s) as bus:
        with pytest.raises(OtherProtocol) as refused:
            ASKS[ask](bus)
        assert refused.value.detail == {"versions": [version], "seen": version, "wanted": "v1"}
        assert f"speak version {version} of the protocol, this client v1" in refused.value.message


def test_the_command_line_says_so_too(tmp_path: Path) -> None:
    with someone_of("v2", endpoint_in(tmp_path)):
        ran = subprocess.run(
            [sys.executable, "-m", "factorbus.cli", "stats", "--connect", endpoint_in(tmp_path), "--timeout", "40"],
            capture_output=True,
            text=True,
            timeout=50,
            check=False,
        )
    assert ran.returncode == 4
    assert "[other_protocol]" in ran.stderr


@pytest.mark.parametrize("ask", ["map", "maps", "features"])
def test_silence_of_nobody_is_silence(tmp_path: Path, ask: str) -> None:
    with (
        zenoh.open(peer(endpoint_in(tmp_path))),
        connect(endpoint_in(tmp_path), timeout_s=1.5) as bus,
        pytest.raises(Unavailable),
    ):
        ASKS[ask](bus)


def test_who_has_been_heard_of_is_waited_for(tmp_path: Path) -> None:
    """At a router one service may be away for a moment while another, newer one is there."""
    service = Service(tmp_path)
    with connect(endpoint_in(tmp_path), timeout_s=60) as bus:
        kitchen = bus.map(MAP)
        kitchen.insert(Draft().point2("l1", (1.0, 2.0)))
        service.close()
        with someone_of("v2", endpoint_in(tmp_path)):
            pending_insert = kitchen.send(Draft().point2("l2", (1.0, 2.0)))
            # Longer than it takes to find that the other one is there, had it looked.
            with pytest.raises(Unavailable):
                kitchen.stats(timeout_s=2.0)
            assert not pending_insert.future.done()


class Older(Service):
    """A service that knows less than this client."""

    def __init__(self, folder: Path, protocol: dict) -> None:
        self.protocol = protocol
        super().__init__(folder)

    def row(self) -> dict:
        return super().row() | {"protocol": self.protocol}


@pytest.mark.parametrize(
    "protocol",
    [
        known() | {"insert": ["sequence", "epoch", "settle", "variables", "factors"]},
        known() | {"changes": ["fix", "free"]},
        {"version": 1, "insert": ["sequence", "changes"]},
    ],
)
def test_changes_that_would_be_skipped_are_not_sent(tmp_path: Path, protocol: dict) -> None:
    service = Older(tmp_path, protocol)
    try:
        with connect(endpoint_in(tmp_path)) as bus, bus.map(MAP, mirror=False) as kitchen:
            with pytest.raises(NotSupported) as refused:
                kitchen.change(Changes().weigh([0], 0.5))
            assert refused.value.detail["what"] == "the change 'weigh'"
            assert service.revision == 0
            assert kitchen.insert(Draft().point2("l1", (1, 2))).sequence == 1, "its number was not used"
    finally:
        service.close()


@pytest.mark.parametrize("fields", [None, ["kind", "keys", "values", "fixed"]])
def test_time_stamps_that_would_be_skipped_are_not_sent(tmp_path: Path, fields: list[str] | None) -> None:
    protocol = {name: value for name, value in known().items() if name != "variable_fields"}
    service = Older(tmp_path, protocol | ({} if fields is None else {"variable_fields": fields}))
    try:
        with connect(endpoint_in(tmp_path)) as bus, bus.map(MAP, mirror=False) as kitchen:
            with pytest.raises(NotSupported) as refused:
                kitchen.insert(Draft().point2("l1", (1, 2), stamp=0))
            assert refused.value.detail["what"] == "time stamps of variables"
            assert kitchen.insert(Draft().point2("l1", (1, 2))).sequence == 1, "its number was not used"
    finally:
        service.close()


def test_what_it_knows_is_sent(tmp_path: Path) -> None:
    service = Older(tmp_path, known())
    try:
        with connect(endpoint_in(tmp_path)) as bus, bus.map(MAP, mirror=False) as kitchen:
            assert kitchen.change(Changes().weigh([0], 0.5)).sequence == 1
            assert kitchen.insert(Draft().point2("l1", (1, 2), stamp=5)).sequence == 2
    finally:
        service.close()
