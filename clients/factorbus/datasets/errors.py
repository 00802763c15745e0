"""Every way in which getting a data set can fail.

DatasetProblem
├── UnknownDataset   unknown_dataset   no data set of that name in the catalogue
├── BadAddress       bad_address       a base address that is no http or https address
├── Unreachable      unreachable       nobody answered there, or not in time
├── HttpStatus       http_status       an answer, but not the file
├── BrokenDownload   broken_download   the answer ended early, or does not end
├── BadChecksum      bad_checksum      bytes other than the catalogue's, before or after the conversion
├── BadSource        bad_source        a line that is not of the form it should be
├── NotShipped       not_shipped       only the gtsam wheel has it, and it is not installed
├── CannotWrite      cannot_write      the folder for data sets cannot be written
│   └── DiskFull     disk_full         ... because there is no room
└── CannotRead       cannot_read       a file that is there but cannot be read
"""

import errno
from pathlib import Path

from factorbus.proto.problems import Problem

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class DatasetProblem(Problem):
    """Base of what can go wrong with a data set."""

    code = "dataset"


class UnknownDataset(DatasetProblem):
    code = "unknown_dataset"

    def __init__(self, name: str, known: tuple[str, ...]) -> None:
        wanted = f"one of {', '.join(known)}"
        super().__init__(f"there is no data set {name[:64]!r}; wanted {wanted}", seen=name[:64], wanted=wanted)


class BadAddress(DatasetProblem):
    code = "bad_address"

    def __init__(self, address: str) -> None:
        wanted = "one such as https://mirror.example/raw"
        super().__init__(f"address {address!r} cannot be fetched from; wanted {wanted}", seen=address, wanted=wanted)


class Unreachable(DatasetProblem):
    code = "unreachable"

    def __init__(self, url: str, reason: str) -> None:
        super().__init__(
            f"{url} cannot be reached: {reason}; check the network and try again, or name a mirror with --from", url=url
        )


class HttpStatus(DatasetProblem):
    code = "http_status"

    def __init__(self, url: str, status: int, reason: str) -> None:
        super().__init__(
            f"{url} answered {status} {reason}; wanted the file: try again later, or name a mirror with --from",
            url=url,
            status=status,
        )


class BrokenDownload(DatasetProblem):
    code = "broken_download"

    def __init__(self, url: str, seen: str, wanted: str) -> None:
        super().__init__(
            f"{url}: {seen}; wanted {wanted}; nothing was kept, try again", url=url, seen=seen, wanted=wanted
        )


class BadChecksum(DatasetProblem):
    """`what` was read or made whole, and is not what the catalogue describes."""

    code = "bad_checksum"

    def __init__(self, what: str, seen: str, wanted: str, then: str) -> None:
        super().__init__(
            f"{what} has SHA-256 {seen[:16]}..., wanted {wanted[:16]}...; {then}", seen=seen, wanted=wanted
        )


class BadSource(DatasetProblem):
    code = "bad_source"

    def __init__(self, file: str, line: int | None, found: str, wanted: str) -> None:
        place = file if line is None else f"{file}:{line}"
        super().__init__(f"{place}: {found}; wanted {wanted}", file=file, line=line)


class NotShipped(DatasetProblem):
    code = "not_shipped"

    def __init__(self, name: str, wanted: str) -> None:
        super().__init__(f"{name} is only shipped with the gtsam wheel, which is not here; {wanted}", name=name)


class CannotWrite(DatasetProblem):
    code = "cannot_write"

    def __init__(self, path: Path, reason: str, then: str) -> None:
        super().__init__(f"{path} cannot be written: {reason}; {then}", path=str(path))


class DiskFull(CannotWrite):
    code = "disk_full"


class CannotRead(DatasetProblem):
    code = "cannot_read"

    def __init__(self, path: Path, reason: str) -> None:
        super().__init__(f"{path} cannot be read: {reason}; make it readable, or fetch it again", path=str(path))


def cannot_write(path: Path, error: OSError) -> CannotWrite:
    """`error`, met in writing `path`, in our words."""
    reason = error.strerror or str(error)
    if error.errno in _FULL:
        return DiskFull(path, reason, "make room there, or set XDG_CACHE_HOME to where there is some")
    return CannotWrite(path, reason, "make the folder writable, or set XDG_CACHE_HOME to one that is")
