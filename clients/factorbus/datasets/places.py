"""Where a data set is looked for: a folder of the user's, the cache, the gtsam wheel."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from factorbus.datasets.catalogue import Dataset, dataset_named
from factorbus.datasets.checksum import sha256_of
from factorbus.datasets.fetch import from_wheel
from factorbus.datasets.known import CATALOGUE


@dataclass(frozen=True, slots=True)
class Places:
    """own: FACTORBUS_DATASETS, None where it is not set.  wheel: gtsam/Data, None where gtsam is not installed."""

    own: Path | None
    cache: Path
    wheel: Path | None

    @classmethod
    def of_this_machine(cls) -> "Places":
        """From the environment; looks for gtsam without importing it."""
        own = os.environ.get("FACTORBUS_DATASETS")
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return cls(Path(own).expanduser() if own else None, cache / "factorbus" / "datasets", _wheel())


@dataclass(frozen=True, slots=True)
class FoundFile:
    """where: "own", "cache" or "wheel"; from the wheel the file at `path` is a source still to be converted."""

    where: str
    path: Path


def find(name: str, places: Places | None = None, catalogue: Sequence[Dataset] = CATALOGUE) -> Path | None:
    """The g2o file of the data set `name`, or None where it is not on this machine.

    What only the gtsam wheel has is converted into the cache first.  What is found is not checked anew: `check` does.
    Raises UnknownDataset; for the wheel also BadChecksum, CannotRead and CannotWrite.
    """
    places = places or Places.of_this_machine()
    dataset = dataset_named(name, catalogue)
    place = locate(dataset, places)
    if place is None or place.where != "wheel":
        return place.path if place else None
    return from_wheel(dataset, place.path.parent, places.cache)


def locate(dataset: Dataset, places: Places) -> FoundFile | None:
    """Where `dataset` is; nothing is converted or changed.  Raises CannotRead for a file of the wheel."""
    for where, folder in (("own", places.own), ("cache", places.cache)):
        if folder is not None and (folder / dataset.file).is_file():
            return FoundFile(where, folder / dataset.file)
    if dataset.wheel is None or places.wheel is None:
        return None
    path = places.wheel / dataset.wheel.paths[0]
    # Another release of gtsam may ship another file under the name.
    if path.is_file() and sha256_of(path) == dataset.wheel.sha256[0]:
        return FoundFile("wheel", path)
    return None


def _wheel() -> Path | None:
    spec = find_spec("gtsam")
    for folder in (spec.submodule_search_locations or ()) if spec else ():
        if (data := Path(folder) / "Data").is_dir():
            return data
    return None
