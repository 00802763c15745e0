"""When a long-running command stops: a signal, or the end of standard input."""

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from factorbus.cli.output.exits import INTERRUPTED
from factorbus.stopping import STOPPING, listening, signalled, stop_on_signals

_ENDED = b"\x1b[?25h\ninterrupted\n"  # the cursor was hidden, if a bar was shown


@contextmanager
def stop_when_asked(until_eof: bool, on_stop: Callable[[], None] = lambda: None) -> Iterator[threading.Event]:
    """An event that SIGTERM, SIGINT and, if asked for, the end of standard input set.  The second signal is final.

    on_stop: called at the first signal, in another thread.
    """
    with stop_on_signals(on_stop, exit_code=INTERRUPTED) as stop:
        if until_eof:
            threading.Thread(target=_wait_for_eof, args=(stop,), daemon=True).start()
        yield stop


@contextmanager
def interrupt_on_sigterm(grace_s: float = 10.0) -> Iterator[None]:
    """While inside, SIGTERM ends the command as Ctrl-C does: through every `finally`.  The second signal is final.

    Both raise KeyboardInterrupt wherever the main thread happens to be, where it may do harm or be lost: in
    a callback from a library that is not Python's, in the midst of taking a lock.  So a command that has not ended
    within `grace_s` after the signal is ended.
    """

    def on_signal(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, on_signal) for number in STOPPING}
    try:
        with listening(lambda told: _see_to_the_end(told, grace_s)):
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _see_to_the_end(told: socket.socket, grace_s: float) -> None:
    """After one signal there are `grace_s` seconds to end by itself, after another there is none."""
    with told:
        if not signalled(told):
            return
        told.settimeout(grace_s)
        with suppress(TimeoutError):
            if not signalled(told):
                return
        os.write(sys.stderr.fileno(), _ENDED)
        os._exit(INTERRUPTED)


def leave_on_eof() -> None:
    """Wait for the end of standard input, then end this process at once: the process that started it has gone."""
    while os.read(sys.stdin.fileno(), 4096):
        pass
    os._exit(INTERRUPTED)


def _wait_for_eof(stop: threading.Event) -> None:
    while os.read(sys.stdin.fileno(), 4096):
        pass
    stop.set()
