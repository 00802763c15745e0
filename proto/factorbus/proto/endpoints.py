"""Addresses on the bus, judged before anything is begun: protocol/address, as Zenoh writes them."""

import re

from factorbus.proto import redact
from factorbus.proto.problems import BadEndpoint

_ENDPOINT = re.compile(r"[a-z-]+/\S+")
_HAVE_PORTS = ("tcp", "udp", "tls", "quic", "ws")
_MOST = 65535


def checked_endpoint(endpoint: str) -> str:
    """`endpoint`, if it can be one.  Raises BadEndpoint."""
    if not _ENDPOINT.fullmatch(endpoint):
        raise BadEndpoint(redact.endpoint(endpoint))
    protocol, _, address = endpoint.partition("/")
    if protocol in _HAVE_PORTS:
        host, _, port = re.split(r"[?#]", address)[0].rpartition(":")
        if not host or not re.fullmatch(r"[0-9]{1,5}", port) or int(port) > _MOST:
            raise BadEndpoint(redact.endpoint(endpoint), f"with a port from 0 to {_MOST}")
    return endpoint
