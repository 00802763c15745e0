"""Whose a file is: folders that hold code, journals or keys, and files of settings, are used only if nobody
else can write to them.

Standard library alone, so that everything may import it.
"""

from factorbus.ownership.folders import (
    UnsafeFolder,
    check_file,
    check_folder,
    check_settings_file,
    make_private,
    private_file,
    why_unsafe,
)

__all__ = [
    "UnsafeFolder",
    "check_file",
    "check_folder",
    "check_settings_file",
    "make_private",
    "private_file",
    "why_unsafe",
]
