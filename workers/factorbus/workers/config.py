"""What an operator may set about a worker."""

import os
from dataclasses import dataclass

from factorbus.proto.endpoints import checked_endpoint
from factorbus.proto.keys import checked_name
from factorbus.proto.problems import Problem
from factorbus.wording import counted


class BadConfig(Problem):
    """A setting that cannot have the value it was given."""

    code = "bad_config"


@dataclass(frozen=True, slots=True)
class WorkerConfig:
    """How a worker is on the bus.

    connect: the service, or a router.  name: in its keys; empty: made up.  slots: jobs at a time, each on a thread
    of its own.  zenoh: path of a Zenoh configuration file for everything not said here (TLS, access control).
    """

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    name: str = ""
    slots: int = 1
    zenoh: str = ""
    warm: bool = True  # compile every kernel before taking the first job


def checked_worker_config(config: WorkerConfig) -> WorkerConfig:
    """`config`, if it can work.  Raises BadConfig, BadEndpoint, BadName."""
    if not config.connect:
        raise BadConfig('there is nothing to connect to; give connect = ["tcp/HOST:7447"]')
    for endpoint in config.connect:
        checked_endpoint(endpoint)
    if not 1 <= config.slots <= 1024:
        raise BadConfig(
            f"slots is {config.slots}; wanted 1 to 1024 (this machine has {counted(os.cpu_count() or 1, 'core')})"
        )
    if config.name:
        checked_name("worker", config.name)
    return config
