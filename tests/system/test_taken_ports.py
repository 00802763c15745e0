"""An address that is taken is said at once: before kernels are compiled, and before other processes are started."""

import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from factorbus.cli.main import main
from factorbus.cli.output.exits import USAGE
from factorbus.cli.process import children
from factorbus.proto.ports import CannotListen, PortTaken, check_free
from factorbus.service import app
from factorbus.service.app import serve
from factorbus.service.config import BadConfig, Config, checked_config

_FREE = ("tcp/127.0.0.1:0",)


@pytest.fixture
def taken() -> Iterator[int]:
    """A port of this machine at which somebody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening.getsockname()[1]


@pytest.fixture
def uncompiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """To prepare the kernels is a failure."""

    def compiles(_: bool) -> None:
        raise AssertionError("the kernels came first")

    monkeypatch.setattr(app, "ready_to_compute", compiles)


def test_a_service_looks_for_its_ports_before_it_compiles(taken: int, uncompiled: None) -> None:
    with pytest.raises(PortTaken, match=f"tcp/127.0.0.1:{taken} is taken"):
        serve(Config(listen=(*_FREE, f"tcp/127.0.0.1:{taken}")), print, threading.Event())
    with pytest.raises(PortTaken, match=f"127.0.0.1:{taken}, for metrics, is taken"):
        serve(Config(listen=_FREE, metrics=f"127.0.0.1:{taken}"), print, threading.Event())
    with pytest.raises(CannotListen, match=r"192\.0\.2\.1:1, for metrics"):
        serve(Config(listen=_FREE, metrics="192.0.2.1:1"), print, threading.Event())


def test_what_keeps_a_service_from_starting_leaves_its_journal_free(taken: int, tmp_path: Path) -> None:
    config = Config(listen=(f"tcp/127.0.0.1:{taken}",), journal=str(tmp_path / "kept"), warm=False)
    for _ in range(2):  # the second would find the folder owned
        with pytest.raises(PortTaken):
            serve(config, print, threading.Event())


def test_one_that_stands_by_waits_for_the_addresses_too(taken: int, uncompiled: None, tmp_path: Path) -> None:
    where = f"127.0.0.1:{taken}"
    config = Config(listen=(f"tcp/{where}",), metrics=where, journal=str(tmp_path), standby=True)
    with pytest.raises(AssertionError, match="the kernels came first"):
        serve(config, print, threading.Event())


def test_a_port_of_metrics_that_is_none_is_a_bad_setting() -> None:
    with pytest.raises(BadConfig, match="wanted a port from 0 to 65535"):
        checked_config(Config(metrics="127.0.0.1:65536"))


def test_a_page_at_a_taken_port_starts_no_solver(
    taken: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def starts(*_: object, **__: object) -> None:
        raise AssertionError("the solver came first")

    monkeypatch.setattr(children, "service", starts)
    file = tmp_path / "two.g2o"
    file.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    assert main(["replay", str(file), "--live", "--port", str(taken)]) == USAGE
    assert f"127.0.0.1:{taken} is taken: another process listens there" in capsys.readouterr().err


def test_a_name_is_free_while_one_of_its_addresses_is(monkeypatch: pytest.MonkeyPatch, taken: int) -> None:
    both = [
        (socket.AF_INET, socket.SOCK_STREAM, 0, "", ("192.0.2.1", 0)),
        (socket.AF_INET, socket.SOCK_STREAM, 0, "", ("127.0.0.1", taken)),
        (socket.AF_INET, socket.SOCK_STREAM, 0, "", ("127.0.0.1", 0)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: both)
    check_free("here", "here", 0)
    del both[2]
    with pytest.raises(PortTaken):
        check_free("here", "here", 0)
    del both[1]
    with pytest.raises(CannotListen):
        check_free("here", "here", 0)
