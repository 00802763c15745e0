"""A service in a process of its own for those who look at maps, and processes that end with the test."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Process, processes


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a service answers that the tests of one file share, each with maps of its own."""
    with processes(tmp_path_factory.mktemp("service")) as start:
        yield start("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0", "--no-warm").ready()[0]


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Start Python processes that end with the test."""
    with processes(tmp_path) as start:
        yield start
