"""What a service manager is notified of; one that does not read, or is gone, keeps nobody from work."""

import logging
import socket
import time
from pathlib import Path

import pytest

from factorbus.cli.process import notify
from factorbus.cli.process.notify import Notifier

WATCHDOG_USEC = "4000"  # a sign of life each millisecond


def bound(path: Path) -> socket.socket:
    made = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    made.bind(str(path))
    return made


def sign(notifier: Notifier) -> None:
    """Time for the next one goes by."""
    end = time.monotonic() + 0.001
    while time.monotonic() < end:
        pass
    notifier.alive([])


@pytest.mark.timeout(60)
def test_a_manager_that_never_reads_is_not_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(notify, "_PATIENCE_S", 0.01)
    manager = bound(tmp_path / "notify")
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": WATCHDOG_USEC})
    with manager, caplog.at_level(logging.WARNING):
        notifier.ready("here")
        for _ in range(2000):  # more than any socket keeps
            sign(notifier)
        notifier.alive(["solver m"])
        notifier.stopping()
        assert [record.message for record in caplog.records if "NOTIFY_SOCKET" in record.message] == [
            "the service manager's socket, NOTIFY_SOCKET, takes nothing (said once): "
            "[Errno 11] Resource temporarily unavailable"
        ]
        manager.setblocking(False)
        assert manager.recv(100) == b"READY=1\nSTATUS=here"
        sign(notifier)  # there is room for one more, and it comes
        came = []
        while (said := _try_read(manager)) is not None:
            came.append(said)
        assert set(came) == {b"WATCHDOG=1"}


def test_a_manager_that_is_gone_costs_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    manager = bound(tmp_path / "notify")
    notifier = Notifier({"NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": WATCHDOG_USEC})
    manager.close()
    notifier.ready("here")
    sign(notifier)
    (tmp_path / "notify").unlink()
    notifier.stopping()
    assert sum("NOTIFY_SOCKET" in record.message for record in caplog.records) == 1


def _try_read(manager: socket.socket) -> bytes | None:
    try:
        return manager.recv(100)
    except BlockingIOError:
        return None
