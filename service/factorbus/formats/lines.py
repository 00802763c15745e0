"""From a file to its lines, in buckets by the name of the record."""

import gzip
import io
import re
import zlib
from dataclasses import dataclass, field
from pathlib import Path

from factorbus.formats.errors import FormatError
from factorbus.wording.unreadable import is_device, mend_of

# Behind a point and before one of these it is a number that is none, as Microsoft's compilers have printed them.
_COMMENT = re.compile(rb"(?<!\.)#|#(?!INF|IND|QNAN|SNAN)")
# From the first character of a line to its end; what is blank in between is passed over at once.
_LINE = re.compile(rb"\S[^\n]*")
# How a file begins that is not the text itself, what it is then, and what makes text of it.
_OTHERWISE = {
    b"BZh": ("packed by bzip2", "bunzip2"),
    b"\xfd7zXZ\x00": ("packed by xz", "unxz"),
    b"\x28\xb5\x2f\xfd": ("packed by zstd", "unzstd"),
    b"PK\x03\x04": ("a zip archive", "unzip"),
    b"7z\xbc\xaf\x27\x1c": ("a 7z archive", "7z x"),
    b"\xff\xfe": ("text in UTF-16", "iconv -f UTF-16 -t UTF-8"),
    b"\xfe\xff": ("text in UTF-16", "iconv -f UTF-16 -t UTF-8"),
}
# Graphs are packed to a third or a twentieth.  A file of some kilobytes could else unpack to all the memory there is.
_GRAPH = "a readable g2o, TORO, iSAM, SLAM++, PyFactorGraph or JRL file"
_MOST_UNPACKED, _MOST_TIMES = 1 << 26, 200


@dataclass(frozen=True, slots=True)
class Bucket:
    """All lines of one record: what follows the name, and the number of the line."""

    rests: list[bytes] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)


def buckets_of(file: str, content: bytes) -> dict[str, Bucket]:
    """The lines of `content` by record, in the order of the file; blank lines and comments are left out.

    A comment begins with a #; that of 1.#INF, as some compilers print an infinity, begins none.
    Raises FormatError when it is not text or has no record.
    """
    if b"\0" in content:
        for begins, (seen, mend) in _OTHERWISE.items():
            if content.startswith(begins):
                raise FormatError(file, None, seen, f"a text file in ASCII or UTF-8, plain or gzipped: {mend}")
        line = content.count(b"\n", 0, content.index(b"\0")) + 1
        raise FormatError(file, line, "a zero byte", "a text file in ASCII or UTF-8")
    if b"\n" not in content:
        content = content.replace(b"\r", b"\n")  # all that ends a line there, as on the Macs of old
    found: dict[bytes, Bucket] = {}
    number, end = 1, -2
    for match in _LINE.finditer(content):
        start = match.start()
        number += 1 if start == end + 1 else content.count(b"\n", max(end, 0), start)
        end = match.end()
        name, *rest = _uncommented(match[0]).split(None, 1) or (b"",)
        if not name:
            continue
        bucket = found.get(name)
        if bucket is None:
            bucket = found[name] = Bucket()
        bucket.rests.append(rest[0] if rest else b"")
        bucket.numbers.append(number)
    if not found:
        raise FormatError(file, None, "no record at all", "lines such as EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1")
    return {name.decode("utf-8", "backslashreplace"): bucket for name, bucket in found.items()}


def _uncommented(line: bytes) -> bytes:
    """`line` up to its comment."""
    found = _COMMENT.search(line) if b"#" in line else None
    return line[: found.start()] if found else line


def read_content(path: Path, wanted: str = _GRAPH) -> bytes:
    """The bytes of the file, unpacked where it is a gzip file, without a byte order mark.

    wanted: what it should be, for the error.  Raises FormatError.
    """
    try:
        if is_device(path):
            raise FormatError(str(path), None, "a device", "a file, or a pipe such as /dev/stdin behind one")
        content = path.read_bytes()
        if content.startswith(b"\x1f\x8b"):
            content = _unpacked(path, content)
    except (OSError, EOFError, zlib.error) as failure:  # gzip reports a damaged file in these three ways
        reason = failure.strerror if isinstance(failure, OSError) and failure.strerror else str(failure)
        mend = "; " + mend_of(failure) if isinstance(failure, OSError) and failure.errno else ""
        if isinstance(failure, IsADirectoryError):
            mend += ", or the folder of a map that GLIM has saved, with graph.txt and submaps"
        raise FormatError(str(path), None, f"it cannot be read ({reason})", f"{wanted}{mend}") from failure
    return content.removeprefix(b"\xef\xbb\xbf")


def _unpacked(path: Path, packed: bytes) -> bytes:
    """Raises FormatError, and what gzip raises."""
    most = max(_MOST_UNPACKED, _MOST_TIMES * len(packed))
    content = gzip.GzipFile(fileobj=io.BytesIO(packed)).read(most + 1)
    if len(content) > most:
        seen = f"gzip that unpacks to more than {_MOST_TIMES} times its size ({len(packed):,})"
        raise FormatError(str(path), None, seen, "a graph, or the file unpacked (gunzip)")
    return content
