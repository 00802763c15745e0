"""What all tests share: their order, where the public data sets are, how hypothesis behaves, a process that stays as it
was."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from longest import rank
from process_state import as_it_was

from examples import USUAL

# Read when NumPy is loaded, here and in every process that a test starts.  By its own way a library of linear algebra
# has a thread for each core, and those of two processes side by side wait for each other in loops: solving the dense
# twins of `tests/solver/test_tree.py` took four times as long with two threads as with one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Started in the background of a script, a process ignores SIGINT, and so do all it starts: those tests that interrupt
# processes would wait for ever.
signal.signal(signal.SIGINT, signal.default_int_handler)

# In CI every run has the same examples, so that a change is judged by what it changes; elsewhere each seeks new ones.
settings.register_profile(
    "factorbus",
    max_examples=USUAL,
    deadline=None,
    derandomize="CI" in os.environ,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
settings.load_profile("factorbus")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The longest files first; all else, and the tests of a file, in their order."""
    items.sort(key=lambda item: rank(item.path))


@pytest.fixture(autouse=True)
def process_stays_as_it_was() -> Iterator[None]:
    """Of all that tests of one process share, none changes anything for the next."""
    with as_it_was():
        yield


@pytest.fixture(scope="session")
def datasets() -> Path:
    """The folder of public data sets; skips where there is none."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    folder = Path(os.environ.get("FACTORBUS_DATASETS", cache / "factorbus" / "datasets"))
    if not (folder / "intel.g2o").is_file():
        pytest.skip(f"no data sets in {folder}: set FACTORBUS_DATASETS to a folder with intel.g2o and the others")
    return folder
