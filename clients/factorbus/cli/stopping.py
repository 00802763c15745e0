"""When a long-running command stops: a signal, or the end of standard input."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from factorbus.cli.exits import INTERRUPTED

_LOOK_S = 0.5


@contextmanager
def stop_on_signals(until_eof: bool, on_stop: Callable[[], None] = lambda: None) -> Iterator[threading.Event]:
    """An event that SIGTERM, SIGINT and, if asked for, the end of standard input set.  The second signal is final.

    on_stop: called at the first signal.
    """
    stop = threading.Event()

    def on_signal(number: int, _frame: object) -> None:
        if stop.is_set():
            os._exit(INTERRUPTED)
        stop.set()
        on_stop()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
    if until_eof:
        threading.Thread(target=_wait_for_eof, args=(stop,), daemon=True).start()
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def wait_until(stop: threading.Event) -> None:
    """Until it is set.  No wait in it is long: Python sees a signal that comes right before one only when it ends."""
    while not stop.wait(_LOOK_S):
        pass


@contextmanager
def interrupt_on_sigterm() -> Iterator[None]:
    """While inside, SIGTERM ends the command as Ctrl-C does: through every `finally`."""

    def on_signal(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, on_signal)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def leave_on_eof() -> None:
    """Wait for the end of standard input, then end this process at once: whoever started it has gone."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(INTERRUPTED)


def _wait_for_eof(stop: threading.Event) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    stop.set()
