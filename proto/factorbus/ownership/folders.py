"""Folders and files that only this user and root can change.

A folder is safe if

- its owner is this user or root;
- nobody else can write to it.  One exception: a folder of root's that is writable by a group of this process, because
  that is how a volume is given to a container (fsGroup in Kubernetes);
- no folder above it lets others put another one in its place: each belongs to this user or root, and is not writable
  by others, nor by a group that is neither root's nor of this process, unless it is sticky (as /tmp is) or a mount
  point (a volume of a container).

On a file system that is mounted read-only nobody can write, so everything there is safe: keys and settings come to a
container so.

A file is safe if its owner is this user or root, and nobody else can write to it.  A file of settings, which people
write, may be writable by a group of this process: what a user makes often is, by a group that has nobody else in it.

Where the system does not tell users apart (Windows) everything is safe.
"""

import os
import shlex
import stat
from pathlib import Path
from typing import Any

_PRIVATE_FOLDER, _PRIVATE_FILE = 0o700, 0o600
_ROOT = 0


class UnsafeFolder(Exception):
    """Somebody else could change what is in a folder that has to be trusted."""

    code = "unsafe_folder"

    def __init__(self, what: str, path: Path, reason: str, mend: str) -> None:
        self.detail: dict[str, Any] = {"folder": str(path), "reason": reason}
        self.message = f"{what} {path} is not used: {reason}; {mend}"
        self._arguments = what, path, reason, mend
        super().__init__(self.message)

    def __reduce__(self) -> tuple[Any, ...]:
        return UnsafeFolder, self._arguments


def check_folder(what: str, path: Path) -> None:
    """Raises UnsafeFolder if others can change what is in the folder `path`; `what` it is, for the message."""
    reason, mend = why_unsafe(path)
    if reason:
        raise UnsafeFolder(what, path, reason, mend)


def make_private(what: str, path: Path) -> None:
    """Make the folder `path`, and those above it that are missing, for this user alone; one that is there is checked.

    Raises UnsafeFolder, OSError.
    """
    missing = [path, *path.parents]
    missing = missing[: next((k for k, folder in enumerate(missing) if folder.exists()), len(missing))]
    for folder in reversed(missing):
        folder.mkdir(mode=_PRIVATE_FOLDER, exist_ok=True)
    check_folder(what, path)


def private_file(path: str, flags: int) -> int:
    """An `opener` for `open`: a file that is made is for this user alone."""
    return os.open(path, flags, _PRIVATE_FILE)


def check_file(what: str, path: Path, status: os.stat_result) -> None:
    """Raises UnsafeFolder if somebody else may have written the file `path`; `status`: of its open descriptor."""
    reason, mend = why_unsafe_itself(path, status, groups=set())
    if reason:
        raise UnsafeFolder(what, path, reason, mend)


def check_settings_file(what: str, path: Path) -> None:
    """Raises UnsafeFolder if others can change the file `path`, or put another one in its place; OSError.

    What is no regular file, such as a pipe, is not looked at.
    """
    if not hasattr(os, "geteuid") or not path.is_file():
        return
    path = path.resolve()
    reason, mend = "", ""
    if not _is_read_only(path):
        reason, mend = _why_unsafe_settings(path, path.stat())
    if reason:
        raise UnsafeFolder(what, path, reason, mend)


def _why_unsafe_settings(path: Path, status: os.stat_result) -> tuple[str, str]:
    user, mode = os.geteuid(), stat.S_IMODE(status.st_mode)
    if status.st_uid not in (user, _ROOT):
        mend = f"chown it to the user that runs this ({user}), or mount it read-only"
        return f"it belongs to user {status.st_uid}", mend
    if mode & stat.S_IWOTH or (mode & stat.S_IWGRP and status.st_gid not in {_ROOT, *_groups()}):
        who = "everybody" if mode & stat.S_IWOTH else f"group {status.st_gid}"
        return f"{who} can write to it (mode {mode:04o})", f"chmod go-w {_quoted(path)}"
    found = ("", "")
    for above in path.parents:
        found = found if found[0] else _why_unsafe_above(path, above, above.stat())
    return found


def why_unsafe(path: Path) -> tuple[str, str]:
    """(why others can change what is in the folder `path`, what to do); empty where they cannot.  Raises OSError."""
    if not hasattr(os, "geteuid"):
        return "", ""
    path = path.resolve()
    if _is_read_only(path):
        return "", ""
    found = why_unsafe_itself(path, path.stat(), _groups())
    for above in path.parents:
        if found[0]:
            break
        found = _why_unsafe_above(path, above, above.stat())
    return found


def why_unsafe_itself(path: Path, status: os.stat_result, groups: set[int]) -> tuple[str, str]:
    if not hasattr(os, "geteuid"):
        return "", ""
    user, mode = os.geteuid(), stat.S_IMODE(status.st_mode)
    if status.st_uid not in (user, _ROOT):
        mend = f"chown it to the user that runs this ({user}), or name another folder"
        return f"it belongs to user {status.st_uid}", mend
    given = status.st_uid == _ROOT and status.st_gid in groups
    if mode & stat.S_IWOTH or (mode & stat.S_IWGRP and not given):
        who = "everybody" if mode & stat.S_IWOTH else f"group {status.st_gid}"
        return f"{who} can write to it (mode {mode:04o})", f"chmod go-w {_quoted(path)}, or name another folder"
    return "", ""


def _why_unsafe_above(path: Path, above: Path, status: os.stat_result) -> tuple[str, str]:
    """Whether others can put another folder in the place of `path`, or of one above it, by writing to `above`."""
    if status.st_uid not in (os.geteuid(), _ROOT) and not _is_unmapped(status.st_uid):
        return f"it is in {above}, which belongs to user {status.st_uid}", "name a folder elsewhere"
    foreign = status.st_mode & stat.S_IWGRP and status.st_gid not in {_ROOT, *_groups()}
    if status.st_mode & stat.S_ISVTX or os.path.ismount(above):
        return "", ""
    if status.st_mode & stat.S_IWOTH:
        return (
            f"it is in {above}, which everybody can write to",
            f"chmod o-w {_quoted(above)}, or name a folder elsewhere",
        )
    if foreign:
        who = f"it is in {above}, which group {status.st_gid} can write to"
        return who, f"chmod g-w {_quoted(above)}, or name a folder elsewhere"
    return "", ""


def _quoted(path: Path) -> str:
    """As a shell takes it."""
    return shlex.quote(str(path))


def _is_read_only(path: Path) -> bool:
    return bool(os.statvfs(path).f_flag & os.ST_RDONLY)


def _groups() -> set[int]:
    return {os.getegid(), *os.getgroups()}


def _is_unmapped(user: int) -> bool:
    """Whether `user` stands for all users of the host that a user namespace (a rootless container) does not show."""
    try:
        whole = Path("/proc/self/uid_map").read_text().split() == ["0", "0", "4294967295"]
        return not whole and user == int(Path("/proc/sys/kernel/overflowuid").read_text())
    except (OSError, ValueError):
        return False
