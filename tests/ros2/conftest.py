"""A service in a process of its own, which the tests here share, and processes that end with the test."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from processes import Process, processes


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A cold machine compiles the kernels first, in the first process that needs them."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(400))


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with processes(tmp_path_factory.mktemp("service")) as start:
        yield start("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0").ready()[0]


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Callable[..., Process]]:
    """Start Python processes that end with the test."""
    with processes(tmp_path) as start:
        yield start
