"""Where a question to the bus ends: never on the thread that asks, where an end would swallow a Ctrl-C."""

import os
import queue
import threading
from collections.abc import Callable, Iterator

import pytest
from processes import Process

from factorbus.client.link import open_link
from factorbus.client.replies import Reply

QUESTIONS = 300


@pytest.fixture
def one_core() -> Iterator[None]:
    """All on one core of the machine, as if it had no other: who asks is often overtaken by the answer."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    yield
    os.sched_setaffinity(0, cores)


@pytest.mark.usefixtures("one_core")
def test_no_question_ends_on_the_thread_that_asks(spawn: Callable[..., Process]) -> None:
    endpoint = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0").ready()[0]
    ends: queue.SimpleQueue[int] = queue.SimpleQueue()

    def end(_: Reply | list[Reply]) -> None:
        ends.put(threading.get_ident())

    link = open_link([endpoint], 60, {})
    try:
        for ask in (link.ask, link.ask_all):
            for _ in range(QUESTIONS):
                ask("nobody/answers/this", b"", 10, end)  # type: ignore[arg-type]
                assert ends.get(timeout=60) != threading.get_ident()
    finally:
        link.close()


def test_a_question_on_a_closed_session_ends_once(endpoint: str) -> None:
    ends: list[Reply | list[Reply]] = []
    link = open_link([endpoint], 60, {})
    link.close()
    link.ask_all("nobody/answers/this", b"", 10, ends.append)
    assert ends == [[]]
