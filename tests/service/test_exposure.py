"""What may be listened on: everything on this machine, and beyond it only what keeps strangers out."""

from pathlib import Path
from typing import Any

import pytest

from factorbus.service.bus.bind_address_check import Exposed, refuse_exposed
from factorbus.service.bus.key_files import UnsafeKeys, refuse_unsafe_keys

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
    ("endpoint", "without", "missing"),
    [
        ("tcp/0.0.0.0:7447", "", "encryption"),
        ("udp/10.0.0.1:7447", "", "encryption"),
        ("tcp/localhost.example.org:7447", "", "encryption"),
        ("tls/0.0.0.0:7447", "transport/link/tls", "certificate"),
        ("tls/0.0.0.0:7447", "access_control", "denies by default"),
    ],
)
def test_one_thing_lacking_is_enough(endpoint: str, without: str, missing: str) -> None:
    settings = {path: value for path, value in SAFE.items() if path != without}
    with pytest.raises(Exposed, match=missing) as caught:
        refuse_exposed(["tcp/127.0.0.1:1", endpoint], settings.get)
    assert caught.value.code == "exposed"
    assert caught.value.detail["endpoint"] == endpoint


def test_a_private_key_in_an_endpoint_is_not_shown() -> None:
    with pytest.raises(Exposed) as caught:
        refuse_exposed(["tls/0.0.0.0:1#listen_private_key_base64=c2VjcmV0"], {}.get)
    assert "c2VjcmV0" not in str(caught.value) + str(caught.value.detail)


@pytest.fixture
def keys(tmp_path: Path) -> dict[str, Any]:
    folder = tmp_path / "keys"
    folder.mkdir(mode=0o700)
    for name in ("ca.pem", "solver.key", "users.txt"):
        (folder / name).touch(mode=0o600)
    return {
        "transport/link/tls": {
            "root_ca_certificate": str(folder / "ca.pem"),
            "listen_private_key": str(folder / "solver.key"),
            "connect_private_key": str(folder / "not_there" / "solver.key"),
        },
        "transport/auth/usrpwd": {"dictionary_file": str(folder / "users.txt")},
    }


def test_keys_that_only_we_can_replace_are_taken(keys: dict[str, Any]) -> None:
    refuse_unsafe_keys("", keys.get)
    refuse_unsafe_keys("", {}.get)


@pytest.mark.parametrize(
    ("section", "name"),
    [
        ("transport/link/tls", "root_ca_certificate"),
        ("transport/link/tls", "listen_private_key"),
        ("transport/auth/usrpwd", "dictionary_file"),
    ],
)
@pytest.mark.parametrize("folder", [True, False], ids=["folder", "file"])
def test_keys_that_others_can_replace_are_refused(keys: dict[str, Any], section: str, name: str, folder: bool) -> None:
    file = Path(keys[section][name])
    other = file.parent.parent / "other"
    other.mkdir(mode=0o700)
    moved = file.rename(other / file.name)
    keys[section][name] = str(moved)
    open_to_all = other if folder else moved
    open_to_all.chmod(0o777)
    with pytest.raises(UnsafeKeys, match="chmod go-w") as caught:
        refuse_unsafe_keys("", keys.get)
    assert (caught.value.code, caught.value.detail["folder"]) == ("unsafe_folder", str(open_to_all))
