"""What may be listened on: everything on this machine, and beyond it only what keeps strangers out."""

from typing import Any

import pytest

from factorbus.service.exposure import Exposed, refuse_exposed

SAFE: dict[str, Any] = {
    "transport/link/tls": {"enable_mtls": True},
    "access_control": {"enabled": True, "default_permission": "deny"},
}
PASSWORDS = SAFE | {"transport/link/tls": {}, "transport/auth/usrpwd": {"dictionary_file": "users.txt"}}


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/127.1.2.3:0",
        "tcp/[::1]:7447",
        "tcp/localhost:1#iface=lo",
        "unixsock-stream//run/f.sock",
    ],
)
def test_this_machine_is_safe(endpoint: str) -> None:
    refuse_exposed([endpoint], {}.get)


@pytest.mark.parametrize("endpoint", ["tls/0.0.0.0:7447", "quic/solver.local:7447", "tls/[::]:7447#so_sndbuf=65000"])
@pytest.mark.parametrize("settings", [SAFE, PASSWORDS])
def test_protected_is_safe(endpoint: str, settings: dict[str, Any]) -> None:
    refuse_exposed([endpoint], settings.get)


@pytest.mark.parametrize(
    ("endpoint", "without", "lacking"),
    [
        ("tcp/0.0.0.0:7447", "", "encryption"),
        ("udp/10.0.0.1:7447", "", "encryption"),
        ("tcp/localhost.example.org:7447", "", "encryption"),
        ("tls/0.0.0.0:7447", "transport/link/tls", "certificate"),
        ("tls/0.0.0.0:7447", "access_control", "denies by default"),
    ],
)
def test_one_thing_lacking_is_enough(endpoint: str, without: str, lacking: str) -> None:
    settings = {path: value for path, value in SAFE.items() if path != without}
    with pytest.raises(Exposed, match=lacking) as caught:
        refuse_exposed(["tcp/127.0.0.1:1", endpoint], settings.get)
    assert caught.value.code == "exposed"
    assert caught.value.detail["endpoint"] == endpoint


def test_a_private_key_in_an_endpoint_is_not_shown() -> None:
    with pytest.raises(Exposed) as caught:
        refuse_exposed(["tls/0.0.0.0:1#listen_private_key_base64=c2VjcmV0"], {}.get)
    assert "c2VjcmV0" not in str(caught.value) + str(caught.value.detail)
