"""Names of maps as folders, and how a new name is made to last."""

import os
import re
from pathlib import Path

# What begins so is on its way: made and not finished, dropped and not yet gone, being imported.  No map's name does.
UNFINISHED, GONE, IMPORTING = ".making-", ".dropped-", ".importing-"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


def maps_in(folder: Path, file: str) -> list[str]:
    """The maps in `folder`: names of folders that have `file`, in order."""
    return sorted(p.parent.name for p in folder.glob(f"*/{file}") if _NAME.fullmatch(p.parent.name) and p.is_file())


def left_behind(folder: Path) -> list[Path]:
    """What somebody who was killed began to make or to remove; an import may still be under way."""
    return [path for path in folder.glob(".*") if path.name.startswith((UNFINISHED, GONE))]


def sync_folder(folder: Path) -> None:
    """Make what was made, named or removed in `folder` survive a power cut.  Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
