"""What the service knows of itself: is it alive, is there memory, and the report that an operator reads."""

import os
import time
from collections.abc import Callable, Mapping
from typing import Any

from factorbus.proto.version import __version__
from factorbus.service.config import Config
from factorbus.service.maps.host import Host
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.process.health import Health, Pulse, Signs
from factorbus.service.process.memory import MemoryLimit

# What others have to say in the report, by name: a function for each, called on any thread.
Chapters = dict[str, Callable[[], Any]]


class HealthReport:
    """Of one service.  `look` is for the thread that ticks; the rest may be called from any."""

    def __init__(
        self,
        config: Config,
        service: str,
        executors: Mapping[str, SerialExecutor],
        hosts: Callable[[], Mapping[str, Host]],
    ) -> None:
        """hosts: the maps there are at the moment."""
        self.health = Health(config.stuck_s)
        self.memory = MemoryLimit(config.limits.memory_bytes)
        self.chapters: Chapters = {}
        self._service, self._started = service, time.monotonic()
        self._pulses = {name: Pulse(executor.hand) for name, executor in executors.items()}
        self._hosts = hosts

    def look(self) -> set[str]:
        """Measure memory, feel every pulse; returns the maps whose solver is stuck."""
        hosts = self._hosts()
        self.memory.look()
        now = time.monotonic()
        executors = {name: pulse.silent_s(now) for name, pulse in self._pulses.items()}
        solvers = {name: host.silent_s() for name, host in hosts.items()}
        closed = {name: why for name, host in hosts.items() if (why := host.unwritable)}
        self.health.seen(
            Signs(now, executors | {f"solver {name}": seconds for name, seconds in solvers.items()}, closed)
        )
        return {name for name, seconds in solvers.items() if seconds > self.health.stuck_s}

    def read(self) -> dict[str, Any]:
        """What admin/stats says, and what the metrics are made of."""
        from factorbus.service.operations.warm import seconds_compiling

        return {
            "service": self._service,
            "version": __version__,
            "pid": os.getpid(),
            "uptime_s": time.monotonic() - self._started,
            "alive": self.health.alive(),
            "ready": self.health.ready(),
            "stuck": self.health.stuck(),
            "missing": self.health.missing(),
            "silent_s": self.health.silent_s(),
            "memory": {"resident_bytes": self.memory.resident, "limit_bytes": self.memory.limit},
            "kernels_compiled_s": seconds_compiling(),
            "maps": [host.operator_stats() for host in self._hosts().values()],
            **{name: more() for name, more in self.chapters.items()},
        }
