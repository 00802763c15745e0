"""A future that may be interrupted: waited for by threads, by asyncio, and by one that a signal takes away."""

import asyncio
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import FrameType

import pytest

from factorbus.client.interruptible_future import InterruptibleFuture

WAITERS = 4
INTERRUPTS = 200
_PAUSE_S = 1e-4


def test_all_who_wait_get_it() -> None:
    future: InterruptibleFuture[int] = InterruptibleFuture()
    with ThreadPoolExecutor(WAITERS) as pool:
        waiting = [pool.submit(future.result, 60) for _ in range(WAITERS)]
        future.set_result(7)
        assert [each.result() for each in waiting] == [7] * WAITERS
    assert future.result() == future.result(0) == 7
    assert future.exception() is None


def test_what_failed_raises_for_all() -> None:
    future: InterruptibleFuture[int] = InterruptibleFuture()
    future.set_exception(KeyError("x1"))
    for _ in range(2):
        with pytest.raises(KeyError, match="x1"):
            future.result(0)
    assert isinstance(future.exception(0), KeyError)


@pytest.mark.parametrize("timeout_s", [0.0, 0.001, -1.0])
def test_time_is_up(timeout_s: float) -> None:
    future: InterruptibleFuture[int] = InterruptibleFuture()
    with pytest.raises(TimeoutError):
        future.result(timeout_s)
    assert not future.done()


def test_asyncio_waits_for_it_and_cannot_cancel_it() -> None:
    future: InterruptibleFuture[int] = InterruptibleFuture()

    async def wait() -> int:
        impatient = asyncio.wrap_future(future)
        impatient.cancel()
        patient = asyncio.wrap_future(future)
        threading.Thread(target=future.set_result, args=(7,)).start()
        return await patient

    assert asyncio.run(wait()) == 7
    assert not future.cancelled()


@pytest.fixture
def interrupts() -> Iterator[None]:
    """A signal raises KeyboardInterrupt here again and again, wherever Python happens to be."""

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, on_signal)
    yield
    signal.setitimer(signal.ITIMER_REAL, 0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.usefixtures("interrupts")
def test_interrupted_again_and_again_it_still_can_be_kept() -> None:
    for number in range(INTERRUPTS):
        future: InterruptibleFuture[int] = InterruptibleFuture()
        end = time.monotonic() + 60
        try:
            signal.setitimer(signal.ITIMER_REAL, _PAUSE_S * (1 + number % 7))
            while time.monotonic() < end:
                with_no_time(future)
            pytest.fail("no signal came in a minute")
        except KeyboardInterrupt:
            keeper = threading.Thread(target=future.set_result, args=(number,), daemon=True)
            keeper.start()
            keeper.join(10)
            assert not keeper.is_alive(), "the lock is held by nobody"
            assert future.result(10) == number


def with_no_time(future: InterruptibleFuture[int]) -> None:
    try:
        future.result(0)
    except TimeoutError:
        return
    pytest.fail("there is nothing to get yet")
