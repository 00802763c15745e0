"""Is what a service listens on safe to be reached from other machines?  If not, it does not listen.

Safe is: on this machine only; or encrypted (TLS, QUIC), with everybody known by a certificate or a password, and with
access control that denies by default.
"""

import ipaddress
from collections.abc import Callable, Sequence
from typing import Any

from factorbus.proto import redact
from factorbus.service.config import BadConfig

_ENCRYPTED = ("tls", "quic")
_LOCAL = ("unixsock-stream", "unixpipe", "vsock", "serial")


class Exposed(BadConfig):
    """The service would listen to other machines, without what keeps strangers out."""

    code = "exposed"

    def __init__(self, endpoint: str, missing: Sequence[str]) -> None:
        shown = redact.endpoint(endpoint)
        super().__init__(
            f"{shown} can be reached from other machines, and there is no {' and no '.join(missing)}; see deploy/zenoh "
            f"for a configuration that has it, listen on 127.0.0.1, or say --insecure to be open to everybody"
        )
        self.detail |= {"endpoint": shown, "missing": list(missing)}


def refuse_exposed(listen: Sequence[str], setting: Callable[[str], Any]) -> None:
    """Raises Exposed.  setting: the value at a path of the Zenoh configuration, or None."""
    for endpoint in listen:
        protocol = endpoint.partition("/")[0]
        if protocol in _LOCAL or _is_loopback(endpoint):
            continue
        if missing := [what for what, there in _protection(protocol, setting) if not there]:
            raise Exposed(endpoint, missing)


def _protection(protocol: str, setting: Callable[[str], Any]) -> list[tuple[str, bool]]:
    tls = setting("transport/link/tls") or {}
    users = setting("transport/auth/usrpwd") or {}
    rights = setting("access_control") or {}
    known = bool(users.get("dictionary_file")) or (protocol in _ENCRYPTED and bool(tls.get("enable_mtls")))
    return [
        ("encryption (tls/...)", protocol in _ENCRYPTED),
        ("client certificate (enable_mtls) or password (usrpwd) asked for", known),
        (
            "access control that denies by default",
            rights.get("enabled") is True and rights.get("default_permission") == "deny",
        ),
    ]


def _is_loopback(endpoint: str) -> bool:
    """tcp/127.0.0.1:7447, tcp/[::1]:0#iface=lo.  A name other than localhost may stand for anything."""
    address = endpoint.partition("/")[2].partition("#")[0].partition("?")[0]
    host = address.rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
