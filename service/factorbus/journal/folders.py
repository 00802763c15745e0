"""Names of maps as folders, and how a new name is made to last."""

import contextlib
import glob
import os
import re
import shutil
from collections.abc import Container
from pathlib import Path

from factorbus.journal.problems import JournalUnreadable, UnsafeJournal
from factorbus.ownership import UnsafeFolder, check_folder, make_private

# What begins so is on its way: made and not finished, dropped and not yet gone, being imported.  No map's name does.
UNFINISHED, GONE, IMPORTING = ".making-", ".dropped-", ".importing-"
_WHAT = "the journal"
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")


def maps_in(folder: Path, file: str, known: Container[str] = ()) -> list[str]:
    """The maps in `folder`: names of folders that have `file`, or what is written beside it, in order.

    known: names that are not looked at and not returned.  Raises JournalUnreadable without permission to look; OSError.
    """
    try:
        return _maps_in(folder, file, known)
    except PermissionError as error:
        raise JournalUnreadable(folder, error.strerror or str(error)) from None


def _maps_in(folder: Path, file: str, known: Container[str]) -> list[str]:
    named = [path for path in folder.iterdir() if _NAME.fullmatch(path.name) and path.name not in known]
    return sorted(path.name for path in named if is_map(path, file))


def is_map(folder: Path, file: str) -> bool:
    """Whether `folder` has `file`, or what is written beside it."""
    return any(path.is_file() for kind in (f"{file}*", "checkpoint-*") for path in folder.glob(kind))


def left_behind(folder: Path) -> list[Path]:
    """What somebody who was killed began to make or to remove; an import may still be under way."""
    return [path for path in folder.glob(".*") if path.name.startswith((UNFINISHED, GONE))]


def make_own(folder: Path) -> None:
    """Make `folder` for this user alone, or check the one that is there.  Raises UnsafeJournal, OSError."""
    try:
        make_private(_WHAT, folder)
    except UnsafeFolder as unsafe:
        raise UnsafeJournal(unsafe) from None


def check_own(folder: Path) -> None:
    """Raises UnsafeJournal if others can change what is in `folder`; OSError."""
    try:
        check_folder(_WHAT, folder)
    except UnsafeFolder as unsafe:
        raise UnsafeJournal(unsafe) from None


def make_beside(folder: Path) -> None:
    """Make the folder of a map that is on its way, for this user alone.  Raises UnsafeJournal, OSError."""
    make_own(folder.parent)
    folder.mkdir(mode=0o700)


def own_place_of(path: Path, before: str, behind: str = "") -> Path:
    """Where this process makes what is to be `path`: beside it, under a name that no other process takes.

    What processes that are gone have left there under such names is removed.
    """
    for left in path.parent.glob(f"{glob.escape(before + path.name)}.*{behind}"):
        number = left.name[len(before + path.name) + 1 : len(left.name) - len(behind)]
        if number.isdecimal() and (int(number) == os.getpid() or not _is_alive(int(number))):
            _remove(left)
    return path.with_name(f"{before}{path.name}.{os.getpid()}{behind}")


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    with contextlib.suppress(OSError):
        path.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Make what was made, named or removed in `folder` survive a power cut.  Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
