"""Keys, certificates and passwords that the Zenoh configuration names: nobody else may be able to replace them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from factorbus.ownership import UnsafeFolder, check_file, check_folder, check_settings_file
from factorbus.service.config import UnsafeConfig

_FILES = {
    "transport/link/tls": (
        "root_ca_certificate",
        "listen_certificate",
        "listen_private_key",
        "connect_certificate",
        "connect_private_key",
    ),
    "transport/auth/usrpwd": ("dictionary_file",),
}


class UnsafeKeys(UnsafeConfig):
    """Others could put a key, a certificate or a list of users of their own in the place of ours."""


def refuse_unsafe_keys(zenoh_file: str, setting: Callable[[str], Any]) -> None:
    """Raises UnsafeKeys.  zenoh_file: the Zenoh configuration, which says who may do what; empty: there is none.
    setting: the value at a path of it, or None.

    A file that is not there is left to Zenoh, which says so.
    """
    if zenoh_file:
        try:
            check_settings_file("the Zenoh configuration", Path(zenoh_file))
        except UnsafeFolder as unsafe:
            raise UnsafeKeys(unsafe) from None
    for path, names in _FILES.items():
        named = setting(path) or {}
        for file in [Path(named[name]) for name in names if named.get(name)]:
            what = f"what Zenoh is to know us and others by ({path})"
            try:
                check_folder(what, file.parent)
                check_file(what, file, file.stat())
            except UnsafeFolder as unsafe:
                raise UnsafeKeys(unsafe) from None
            except OSError:
                continue
