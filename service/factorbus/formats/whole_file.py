"""Write a file whole or not at all: what was there before stays until the new one is on disk.

A disk that is full, or a process that ends half way, would leave a file that reads as a smaller graph.  It may be the
file that the graph was read from.
"""

import os
import shutil
from pathlib import Path


def write_whole(path: str | os.PathLike[str], text: str | bytes, encoding: str = "utf-8") -> None:
    """Write a text, or bytes, beside `path`, then put it there.  A link stays a link, a file keeps its permissions.

    What is no regular file, such as a pipe, is written straight, and so is a file in a folder that cannot be written
    to.  Raises OSError.
    """
    target, content = Path(os.path.realpath(path)), text.encode(encoding) if isinstance(text, str) else text
    there = target.exists()
    if (there and not target.is_file()) or not os.access(target.parent, os.W_OK):
        target.write_bytes(content)
        return
    beside = target.with_name(f".{target.name[:200]}.{os.getpid()}.part")
    try:
        beside.write_bytes(content)
        if there:
            shutil.copymode(target, beside)
        beside.replace(target)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise
