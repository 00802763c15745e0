"""Whether anybody listens at an address, asked of the operating system."""

import socket
from collections.abc import Iterable

_STREAMS = ("tcp", "tls", "ws")
_WAIT_S = 1.0


def heard(endpoints: Iterable[str]) -> bool:
    """Whether somebody may listen at one of `endpoints`: False where every machine says at once that nobody does."""
    return any(_may_be_there(endpoint) for endpoint in endpoints)


def _may_be_there(endpoint: str) -> bool:
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    if protocol not in _STREAMS or not port.isdecimal():
        return True  # nothing to be asked without speaking the protocol
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_WAIT_S).close()
    except (ConnectionRefusedError, socket.gaierror, OverflowError):
        return False
    except OSError:
        return True  # silence, or a way that is broken for now
    return True
