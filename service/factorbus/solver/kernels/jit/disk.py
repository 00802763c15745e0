"""Compiled kernels on disk: Numba's cache, in a folder of our choice and in files that nobody else can have written.

A file has the stamp of its kernel in its name (`stamps`).  Of each kernel the last few stay, by when they were used.
"""

import contextlib
import glob
import hashlib
import math
import os
import pickle
import secrets
from collections.abc import Callable, Iterator
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from numba.core import caching

from factorbus.ownership import check_file

__all__ = ["cache_in"]

_KEPT = 6  # of one kernel


def cache_in(folder: Callable[[], Path]) -> Callable[[Callable[..., Any], Callable[[], str]], Any]:
    """Numba's cache of a function, in a folder that is made when it is first asked for: (function, its stamp).

    The stamp is first asked for when a kernel is loaded or kept: what it names may come after it in its file.
    """

    class Locator(caching._CacheLocator):
        def __init__(self, function: Callable[..., Any]) -> None:
            self._name = f"{function.__module__}.{function.__qualname__}"

        def get_cache_path(self) -> str:
            return str(folder())

        def get_source_stamp(self) -> str:
            return self._name

        def get_disambiguator(self) -> str:
            return hashlib.sha256(self._name.encode()).hexdigest()[:8]

        @classmethod
        def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "Locator":
            return cls(py_func)

    class Content(caching.CompileResultCacheImpl):
        _locator_classes = (Locator,)

    class Cache(caching.FunctionCache):
        _impl_class = Content

        def __init__(self, function: Callable[..., Any], stamp: Callable[[], str]) -> None:
            super().__init__(function)
            self._stamp = stamp
            del self._cache_file  # until it is asked for

        @cached_property
        def _cache_file(self) -> caching.IndexDataCacheFile:
            """As Numba makes it, but for its name and for how files are opened."""
            content = self._impl
            name = f"{content.filename_base}-{self._stamp()}"
            return _OwnFiles(self._cache_path, name, content.locator.get_source_stamp())

    return Cache


def used_at(path: Path) -> float:
    """When a file or folder was last used; long ago if another process has removed it meanwhile."""
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return -math.inf


class _OwnFiles(caching.IndexDataCacheFile):
    """The files of one function: written for this user alone, and read only if nobody else can have written them.

    Folders are checked once, when a process begins; a file is checked as it is opened, so that none can be put in its
    place in between.
    """

    def save(self, key: Any, data: Any) -> None:
        super().save(key, data)
        self._drop_others()

    def _drop_others(self) -> None:
        """All but the versions of this function that were used last."""
        name, _, _ = self._index_name.rpartition("-")
        versions = Path(self._cache_path).glob(f"{glob.escape(name)}-*.nbi")
        for path in sorted(versions, key=used_at)[:-_KEPT]:
            for one in (path, *path.parent.glob(f"{glob.escape(path.stem)}.*.nbc")):
                one.unlink(missing_ok=True)

    def _load_index(self) -> dict[Any, str]:
        try:
            with _opened(self._index_path) as file:
                version, data = pickle.load(file), file.read()
            with contextlib.suppress(OSError):  # a folder that is only read
                os.utime(self._index_path)
        except FileNotFoundError:
            return {}
        if version != self._version:
            return {}
        stamp, overloads = pickle.loads(data)
        return overloads if stamp == self._source_stamp else {}

    def _load_data(self, name: str) -> Any:
        with _opened(self._data_path(name)) as file:
            return pickle.loads(file.read())

    @contextlib.contextmanager
    def _open_for_write(self, filepath: str) -> Iterator[IO[bytes]]:
        beside = f"{filepath}.tmp.{secrets.token_hex(8)}"
        try:
            with open(beside, "xb", opener=_for_us_alone) as file:
                yield file
            os.replace(beside, filepath)
        except Exception:
            Path(beside).unlink(missing_ok=True)
            raise


def _opened(path: str) -> IO[bytes]:
    """A file of the cache, to be read.  Raises UnsafeFolder: somebody else may have written it; OSError."""
    file = open(path, "rb")  # noqa: SIM115
    try:
        check_file("the compiled kernel", Path(path), os.fstat(file.fileno()))
    except BaseException:
        file.close()
        raise
    return file


def _for_us_alone(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
