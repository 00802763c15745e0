"""One file over http, into a file, whole or not at all."""

import http.client
import ssl
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote, urlsplit

from factorbus.datasets.catalogue import Source
from factorbus.datasets.errors import BadAddress, BrokenDownload, HttpStatus, Unreachable, cannot_write
from factorbus.proto.version import __version__
from factorbus.wording import counted

GITHUB = "https://raw.githubusercontent.com"

# (bytes so far, bytes in all or None where the server does not say)
Progress = Callable[[int, int | None], None]

_CHUNK = 1 << 16
_LIMIT = 256 << 20  # many times the largest source; a server that never ends must not fill the disk


def addresses(source: Source, base: str = GITHUB) -> list[str]:
    """Where the files of `source` are: base/repository/commit/path.  Raises BadAddress."""
    parts = urlsplit(base)
    if parts.scheme not in ("http", "https") or not parts.netloc or parts.query or parts.fragment:
        raise BadAddress(base)
    return [f"{base.rstrip('/')}/{source.repository}/{source.commit}/{quote(path)}" for path in source.paths]


def download(url: str, target: Path, *, timeout_s: float = 30.0, progress: Progress | None = None) -> None:
    """Write what `url` answers to `target`; `timeout_s` is for each silence, not for the whole.

    Raises Unreachable, HttpStatus, BrokenDownload, CannotWrite; what `target` holds then is to be thrown away.
    """
    request = urllib.request.Request(url, headers={"User-Agent": f"factorbus/{__version__}"})
    try:
        with urllib.request.urlopen(request, timeout=timeout_s) as answer:
            _store(answer, url, target, progress)
    except urllib.error.HTTPError as error:
        error.close()
        # Of redirects in circles urllib makes a text of several lines.
        reason = "and sends one elsewhere without end" if 300 <= error.code < 400 else str(error.reason)
        raise HttpStatus(url, error.code, reason) from error
    except urllib.error.URLError as error:
        raise Unreachable(url, _words(error.reason, timeout_s)) from error
    except http.client.IncompleteRead as error:
        raise BrokenDownload(url, "the connection was cut in the middle of the file", "all of it") from error
    except http.client.HTTPException as error:
        raise BrokenDownload(url, f"an answer that is not http ({type(error).__name__})", "the file") from error
    except OSError as error:  # of the connection: those of the file are caught where they arise
        raise Unreachable(url, _words(error, timeout_s)) from error


def _store(answer: Any, url: str, target: Path, progress: Progress | None) -> None:
    length = answer.headers.get("Content-Length", "")
    total = int(length) if length.isdigit() else None
    done = 0
    with _writing(target) as write:
        while chunk := answer.read(_CHUNK):
            done += len(chunk)
            if done > _LIMIT:
                raise BrokenDownload(url, f"more than {_LIMIT} bytes", "a data set")
            write(chunk)
            if progress:
                progress(done, total)
    if total is not None and done != total:  # read(n) ends silently where the connection does
        raise BrokenDownload(url, f"the connection was cut after {counted(done, 'byte')}", counted(total, "byte"))


class _writing:  # noqa: N801
    """The file to write; its errors are told apart from those of the connection."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> Callable[[bytes], None]:
        try:
            self._file = self.path.open("wb", buffering=0)
        except OSError as error:
            raise cannot_write(self.path, error) from error
        return self._write

    def _write(self, chunk: bytes) -> None:
        rest = memoryview(chunk)
        try:
            while rest:  # unbuffered files may take a part
                rest = rest[self._file.write(rest) :]
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def __exit__(self, *_: object) -> None:
        self._file.close()


def _words(reason: object, timeout_s: float) -> str:
    if isinstance(reason, TimeoutError):
        return f"no answer for {timeout_s:g} s"
    if isinstance(reason, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted ({reason.verify_message})"
    if isinstance(reason, OSError) and reason.strerror:
        return reason.strerror
    return str(reason) or type(reason).__name__
