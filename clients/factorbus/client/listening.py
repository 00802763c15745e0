"""Whether anybody listens at an address, asked of the operating system."""

import socket
from collections.abc import Iterable

_STREAMS = ("tcp", "tls", "ws")
_WAIT_S = 1.0


def heard(endpoints: Iterable[str]) -> bool:
    """Whether somebody may listen at one of `endpoints`: False where every machine says at once that nobody does."""
    return any(_may_be_there(endpoint) for endpoint in endpoints)


def unresolved(endpoints: Iterable[str]) -> list[str]:
    """The names of machines in `endpoints`, where none of them has an address; else nothing."""
    names = []
    for endpoint in endpoints:
        protocol, host, _ = _parts(endpoint)
        try:
            if protocol not in _STREAMS:
                return []
            socket.getaddrinfo(host, None)
            return []
        except (socket.gaierror, UnicodeError):
            names.append(host)
    return names


def _parts(endpoint: str) -> tuple[str, str, str]:
    """(protocol, host, port)"""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    return protocol, host.strip("[]"), port


def _may_be_there(endpoint: str) -> bool:
    protocol, host, port = _parts(endpoint)
    if protocol not in _STREAMS or not port.isdecimal():
        return True  # nothing to be asked without speaking the protocol
    try:
        socket.create_connection((host, int(port)), timeout=_WAIT_S).close()
    except (ConnectionRefusedError, socket.gaierror, OverflowError):
        return False
    except OSError:
        return True  # silence, or a way that is broken for now
    return True
