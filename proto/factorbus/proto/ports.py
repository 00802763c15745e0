"""Addresses that cannot be listened at: taken by somebody else, or none of this machine."""

import errno
import socket
from collections.abc import Iterable

from factorbus.proto.problems import Problem

_STREAMS = ("tcp", "tls", "ws")


class PortTaken(Problem):
    """Another process listens there."""

    code = "port_taken"

    def __init__(self, where: str) -> None:
        super().__init__(
            f"{where} is taken: another process listens there (`ss -ltnp` says which); stop it, or give another port",
            where=where,
        )


class CannotListen(Problem):
    """The address is none of this machine, or its port is not for this user."""

    code = "cannot_listen"

    def __init__(self, where: str, reason: str) -> None:
        super().__init__(
            f"cannot listen at {where}: {reason}; wanted an address of this machine and a port that this user may have",
            where=where,
        )


def listening_problem(where: str, error: OSError) -> Problem:
    """What `error` means of listening at `where`."""
    if error.errno == errno.EADDRINUSE:
        return PortTaken(where)
    return CannotListen(where, error.strerror or str(error))


def check_free(where: str, host: str, port: int) -> None:
    """Whether a process could listen at `host`:`port` now; `where` is how an error calls it.

    One of the addresses that `host` is a name of will do.  Raises PortTaken, CannotListen.
    """
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        raise listening_problem(where, error) from None
    except OverflowError:
        raise CannotListen(where, "a port is 0 to 65535") from None
    problems = []
    for family, kind, _, _, address in addresses:
        try:
            with socket.socket(family, kind) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
                probe.listen(1)
            return
        except OverflowError:
            raise CannotListen(where, "a port is 0 to 65535") from None
        except OSError as error:
            problems.append(listening_problem(where, error))
    raise next((each for each in problems if isinstance(each, PortTaken)), problems[0])


def check_endpoints(endpoints: Iterable[str]) -> None:
    """The same of endpoints as Zenoh writes them; those that the operating system cannot be asked about pass."""
    for endpoint in endpoints:
        protocol, _, address = endpoint.partition("/")
        host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
        if protocol in _STREAMS and port.isdecimal() and "iface=" not in address:
            check_free(f"{protocol}/{host}:{port}", host.strip("[]"), int(port))
