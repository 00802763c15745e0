"""One service for the tests that leave it running, and a way to start processes for those that do not."""

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from journalled import NURSERY, Services
from processes import COMPILING_S, Process, processes


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A cold machine compiles the kernels first, in the first process that needs them."""
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.timeout(400))


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Where a service answers that the tests of one file share, each with maps of its own."""
    folder = tmp_path_factory.mktemp("service")
    settings = folder / "service.toml"
    settings.write_text("[limits]\nmessage_bytes = 200_000\nparked_s = 0.5\n")
    with processes(folder) as start:
        service = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings))
        yield service.ready()[0]


@pytest.fixture
def spawn(tmp_path: pytest.TempPathFactory) -> Iterator[Callable[..., Process]]:
    """Start Python processes that end with the test."""
    with processes(tmp_path) as start:  # type: ignore[arg-type]
        yield start


@pytest.fixture(scope="session")
def nurseries(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[int], Process]]:
    """Processes that have everything compiled, and fork services: nurseries(n) is the n-th."""
    with processes(tmp_path_factory.mktemp("nurseries")) as start:
        born: list[Process] = []

        def nursery(number: int) -> Process:
            while len(born) <= number:
                born.append(start(NURSERY))
                born[-1].line("nursery", COMPILING_S)
            return born[number]

        yield nursery


@pytest.fixture
def services(nurseries: Callable[[int], Process]) -> Iterator[Callable[..., Services]]:
    """Services with a journal in a folder, one after the other: services(FOLDER, "setting=value", ...)."""
    started: list[Services] = []

    def start(journal: Path, *settings: str) -> Services:
        started.append(Services(nurseries(len(started)), journal, settings))
        return started[-1]

    try:
        yield start
    finally:
        for each in started:
            each.end(signal.SIGKILL)
            each.forget()
