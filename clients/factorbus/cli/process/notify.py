"""What systemd is notified of: ready, stopping, and, while the service is alive, that it is (sd_notify(3)).

A unit with `Type=notify` and `WatchdogSec=` has the service restarted when it got no sign for that long.  It is not
sent on a timer: only after the service has looked at its threads and found none of them stuck.
"""

import logging
import os
import socket
import time
from collections.abc import Mapping

log = logging.getLogger(__name__)

_PATIENCE_S = 1.0  # for what is said once, where the socket is full


class Notifier:
    """Tells the service manager, if there is one."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._every_s = _watchdog_s(environment) / 4
        self._told = 0.0
        self._warned = False

    def ready(self, status: str) -> None:
        """Work can come."""
        self._tell(f"READY=1\nSTATUS={status}", _PATIENCE_S)

    def stopping(self) -> None:
        """On the way out."""
        self._tell("STOPPING=1\nSTATUS=finishing what was accepted", _PATIENCE_S)

    def alive(self, stuck: list[str]) -> None:
        """The service has looked at itself.  Who is stuck, if anybody: then the watchdog is not fed."""
        now = time.monotonic()
        if stuck:
            self._tell(f"STATUS=stuck: {', '.join(stuck)}")
        elif self._every_s and now - self._told >= self._every_s and self._tell("WATCHDOG=1"):
            self._told = now

    def _tell(self, text: str, patience_s: float = 0.0) -> bool:
        """Whether it was sent.  A manager that does not read, or is gone, costs `patience_s` at most and no work."""
        if not self._address:
            return False
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as line:
            line.settimeout(patience_s)
            try:
                line.sendto(text.encode(), self._address)
            except OSError as error:
                if not self._warned:
                    log.warning("the service manager's socket, NOTIFY_SOCKET, takes nothing (said once): %s", error)
                self._warned = True
                return False
        return True


def _address(name: str) -> str:
    """@name is in the abstract namespace."""
    return "\0" + name[1:] if name.startswith("@") else name


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """What the unit's WatchdogSec says, if it is about this process; 0: there is none."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0.0
    return int(environment.get("WATCHDOG_USEC", "0")) / 1e6
