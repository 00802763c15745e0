"""Where the kernel says what this process may have: its control group and those above, of either version.

In a container its own group is the root of what it sees.
"""

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

GROUPS, ROOT = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")


def limit_files(controller: str, first: str, second: str) -> Iterator[Path]:
    """Files that there may be with a limit.  first, second: how it is called in version 1 and in version 2."""
    for line in GROUPS.read_text().splitlines() if GROUPS.is_file() else ():
        _, controllers, path = line.split(":", 2)
        if controllers and controller not in controllers.split(","):
            continue
        own = PurePosixPath(path.lstrip("/"))
        for each in (own, *own.parents):
            yield ROOT / controllers / each / (first if controllers else second)
