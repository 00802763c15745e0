"""What systemd is notified of: ready, stopping, and, while the service is alive, that it is (sd_notify(3)).

A unit with `Type=notify` and `WatchdogSec=` has the service restarted when it got no sign for that long.  It is not
sent on a timer: only after the service has looked at its threads and found none of them stuck.
"""

import os
import socket
import time
from collections.abc import Mapping


class Notifier:
    """Tells the service manager, if there is one."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._every_s = _watchdog_s(environment) / 4
        self._told = 0.0

    def ready(self, status: str) -> None:
        """Work can come."""
        self._tell(f"READY=1\nSTATUS={status}")

    def stopping(self) -> None:
        """On the way out."""
        self._tell("STOPPING=1\nSTATUS=finishing what was accepted")

    def alive(self, stuck: list[str]) -> None:
        """The service has looked at itself.  Who is stuck, if anybody: then the watchdog is not fed."""
        now = time.monotonic()
        if stuck:
            self._tell(f"STATUS=stuck: {', '.join(stuck)}")
        elif self._every_s and now - self._told >= self._every_s:
            self._told = now
            self._tell("WATCHDOG=1")

    def _tell(self, text: str) -> None:
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
            line.sendto(text.encode(), self._address)


def _address(name: str) -> str:
    """@name is in the abstract namespace."""
    return "\0" + name[1:] if name.startswith("@") else name


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """What the unit's WatchdogSec says, if it is about this process; 0: there is none."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    return int(environment.get("WATCHDOG_USEC", "0")) / 1e6
