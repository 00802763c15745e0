"""How commands come to the bus: an address where nobody listens is said within a second, starting included."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from factorbus.cli.process.options import MapAddress

if TYPE_CHECKING:
    from factorbus.client import Bus, Interest, Map

_LISTENING_S = 0.6


def open_bus(endpoint: str, client: str, zenoh: str = "", timeout_s: float = 10.0) -> "Bus":
    """A connection to what is at `endpoint`; `timeout_s` is for its answers.  Raises as `factorbus.client.connect`."""
    from factorbus.client import connect

    return connect(endpoint, client=client, zenoh=zenoh, timeout_s=timeout_s, listening_s=_LISTENING_S)


@contextmanager
def joined_map(address: MapAddress, client: str) -> Iterator["Map"]:
    """The map at `address`, joined only if it is there.  Raises as `factorbus.client.connect`, and UnknownMap."""
    with (
        open_bus(address.endpoint, client, address.zenoh, address.timeout_s) as bus,
        bus.map(address.name, mirror=False, create=False) as joined,
    ):
        yield joined


@contextmanager
def joined_when_there(
    bus: "Bus", name: str, stopped: Callable[[float], bool], interest: "Interest | None" = None
) -> Iterator["Map | None"]:
    """Map `name`, once there is one; None if it was stopped before.  stopped: waits for that many seconds, at most.

    interest: the part of it to follow.  Raises Refused, Unavailable.
    """
    from factorbus.cli.output.console import print_note
    from factorbus.proto.problems import UnknownMap

    said = False
    while True:
        try:
            joined = bus.map(name, create=False, interest=interest)
            break
        except UnknownMap as unknown:
            if not said:
                print_note(f"{unknown.message}; waiting until there is one")
            said = True
        if stopped(_LISTENING_S):
            yield None
            return
    with joined:
        yield joined
