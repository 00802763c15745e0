"""SHA-256 of files, and whether a file is the data set it should be."""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from factorbus.datasets.catalogue import Dataset
from factorbus.datasets.errors import CannotRead


@dataclass(frozen=True, slots=True)
class ChecksumResult:
    """What a file turned out to be."""

    name: str
    path: Path
    seen: str
    wanted: str

    @property
    def good(self) -> bool:
        return self.seen == self.wanted


def check_dataset(dataset: Dataset, path: Path) -> ChecksumResult:
    """Hold the file at `path` against the catalogue.  Raises CannotRead."""
    return ChecksumResult(dataset.name, path, sha256_of(path), dataset.sha256)


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file.  Raises CannotRead."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise CannotRead(path, error.strerror or str(error)) from error
