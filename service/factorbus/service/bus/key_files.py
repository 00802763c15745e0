"""Keys, certificates and passwords that the Zenoh configuration names: nobody else may be able to replace them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from factorbus.ownership import UnsafeFolder, check_file, check_folder
from factorbus.service.config import BadConfig

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


class UnsafeKeys(BadConfig):
    """Others could put a key, a certificate or a list of users of their own in the place of ours."""

    code = "unsafe_folder"

    def __init__(self, unsafe: UnsafeFolder) -> None:
        super().__init__(unsafe.message)
        self.detail |= unsafe.detail


def refuse_unsafe_keys(setting: Callable[[str], Any]) -> None:
    """Raises UnsafeKeys.  setting: the value at a path of the Zenoh configuration, or None.

    A file that is not there is left to Zenoh, which says so.
    """
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
