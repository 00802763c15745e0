"""What to do about a file that cannot be read, for a person; and which is none."""

import errno
import os
import stat

_OTHERWISE = "look whether its disk is there and sound"


def is_device(path: str | os.PathLike[str]) -> bool:
    """Whether reading it may have no end, as that of /dev/zero; a pipe has one."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):  # who reads it says so
        return False
    return stat.S_ISCHR(mode) or stat.S_ISBLK(mode)


def mend_of(error: OSError) -> str:
    """The next step after `error`, which says itself what went wrong."""
    if isinstance(error, IsADirectoryError):
        return "it is a folder: name a file in it"
    if isinstance(error, FileNotFoundError | NotADirectoryError):
        return "look for its name with ls; a path that does not begin with / is from the folder you are in"
    if isinstance(error, PermissionError):
        return "have its owner allow it, chmod a+r, of a folder a+rx, or run this as its owner"
    if error.errno in (errno.ENAMETOOLONG, errno.ELOOP):
        return "name another path"
    return _OTHERWISE
