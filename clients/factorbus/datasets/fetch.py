"""From the public source to a checked file in the cache."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from factorbus.datasets.catalogue import Dataset, Source
from factorbus.datasets.checksum import sha256_of
from factorbus.datasets.convert import convert
from factorbus.datasets.download import GITHUB, addresses, download
from factorbus.datasets.errors import BadChecksum, CannotRead, NotShipped, cannot_write

# (file name, bytes so far, bytes in all or None)
Watch = Callable[[str, int, int | None], None]


def fetch_dataset(
    dataset: Dataset,
    cache: Path,
    *,
    wheel: Path | None = None,
    base: str = GITHUB,
    timeout_s: float = 30.0,
    watch: Watch | None = None,
    keep_source: bool = False,
) -> Path:
    """Put `dataset` into the folder `cache`, checked before and after the conversion; returns the file.

    What the gtsam wheel (its folder gtsam/Data) ships is taken from there, everything else is downloaded from `base`.
    `keep_source` leaves the checked source in cache/sources, also when the conversion fails.  A file that is there
    and good is left alone.  Raises DatasetProblem; then the cache is as it was.
    """
    target = cache / dataset.file
    if target.is_file() and sha256_of(target) == dataset.sha256:
        return target
    if wheel is not None and _ships(dataset, wheel):
        return from_wheel(dataset, wheel, cache)
    if dataset.download is None:
        raise NotShipped(dataset.name, "pip install 'gtsam==4.3.0', then try again")
    source = dataset.download
    urls = addresses(source, base)
    with _workbench(cache) as bench:
        files = []
        for url, path, wanted in zip(urls, source.paths, source.sha256, strict=True):
            file = bench / f"{len(files)}-{Path(path).name}"
            download(url, file, timeout_s=timeout_s, progress=_watching(watch, Path(path).name))
            _same(file, url, wanted, "nothing was kept: it is not the file of that commit; try again, or use --from")
            files.append(file)
        contents = [(Path(path).name, _read(file)) for path, file in zip(source.paths, files, strict=True)]
        if keep_source:
            _keep(files, cache / "sources" / dataset.name)
        return _converted(dataset, source, contents, bench, target)


def from_wheel(dataset: Dataset, wheel: Path, cache: Path) -> Path:
    """Convert the file that the gtsam wheel ships, into the folder `cache`; returns the file.

    Raises DatasetProblem; then the cache is as it was.
    """
    source = dataset.wheel
    if source is None:
        raise NotShipped(dataset.name, "fetch it")
    with _workbench(cache) as bench:
        files = [wheel / path for path in source.paths]
        for file, wanted in zip(files, source.sha256, strict=True):
            _same(file, str(file), wanted, "wanted the one of gtsam 4.3.0: pip install 'gtsam==4.3.0', or fetch it")
        contents = [(file.name, _read(file)) for file in files]
        return _converted(dataset, source, contents, bench, cache / dataset.file)


def _ships(dataset: Dataset, wheel: Path) -> bool:
    source = dataset.wheel
    return source is not None and all(
        (wheel / path).is_file() and sha256_of(wheel / path) == wanted
        for path, wanted in zip(source.paths, source.sha256, strict=True)
    )


@contextmanager
def _workbench(cache: Path) -> Iterator[Path]:
    """A folder inside `cache`, so that moving out of it is atomic; gone afterwards, come what may."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        bench = Path(tempfile.mkdtemp(prefix=".fetch-", dir=cache))
    except OSError as error:
        raise cannot_write(cache, error) from error
    try:
        yield bench
    finally:
        shutil.rmtree(bench, ignore_errors=True)


def _watching(watch: Watch | None, name: str) -> Callable[[int, int | None], None] | None:
    if watch is None:
        return None
    return lambda done, total: watch(name, done, total)


def _same(file: Path, what: str, wanted: str | None, then: str) -> None:
    """Raise BadChecksum unless `file` has SHA-256 `wanted`; None wants nothing."""
    if wanted is not None and (seen := sha256_of(file)) != wanted:
        raise BadChecksum(what, seen, wanted, then)


def _converted(dataset: Dataset, source: Source, contents: list[tuple[str, bytes]], bench: Path, target: Path) -> Path:
    """Convert, check, and move into place."""
    made = bench / dataset.file
    text = convert(source.form, contents)
    try:
        with made.open("wb") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise cannot_write(target, error) from error
    known = "the source is as recorded, so the conversion is wrong here: please report it"
    unknown = "the source has no recorded checksum and may be another file"
    _same(
        made,
        f"{dataset.file} as converted",
        dataset.sha256,
        f"nothing was kept: {unknown if None in source.sha256 else known} (--keep-source keeps the source to look at)",
    )
    try:
        os.replace(made, target)
    except OSError as error:
        raise cannot_write(target, error) from error
    return target


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise CannotRead(file, error.strerror or str(error)) from error


def _keep(files: list[Path], folder: Path) -> None:
    """Move the checked sources out of the workbench."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in files:
            os.replace(file, folder / file.name.partition("-")[2])
    except OSError as error:
        raise cannot_write(folder, error) from error
