"""A service that fails when a test asks it to, for the tests of clients."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from faulty.service import Service, endpoint_in


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Service]]:
    running: list[Service] = []

    def begin(epoch: int = 1) -> Service:
        running.append(Service(tmp_path, epoch))
        return running[-1]

    yield begin
    for service in running:
        service.close()


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return endpoint_in(tmp_path)
