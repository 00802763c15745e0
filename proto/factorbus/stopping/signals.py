"""SIGTERM and SIGINT set an event, from a thread that does nothing else.

A handler in Python must not set it itself.  It would run in the main thread, between any two of its instructions, and
`Event.set` takes the lock that `Event.wait` holds for a moment: the main thread would wait for itself for ever.  It
would also be late: Python notices a signal that comes right before a wait only when the wait ends.  So the handler
does nothing, and the thread reads what the C part of Python writes for each signal (`signal.set_wakeup_fd`).
"""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

STOPPING = (signal.SIGTERM, signal.SIGINT)


@contextmanager
def stop_on_signals(
    on_stop: Callable[[], None] = lambda: None, exit_code: int | None = None
) -> Iterator[threading.Event]:
    """An event that the first SIGTERM or SIGINT sets.  Only the main thread may enter, as with every handler.

    on_stop: called after the event is set, in a thread of its own.
    exit_code: the second signal ends the process at once with this one; None: it changes nothing.
    """
    stop = threading.Event()
    with listening(lambda told: _see_to_it(told, stop, on_stop, exit_code)):
        before = {number: signal.signal(number, lambda *_: None) for number in STOPPING}
        try:
            yield stop
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def listening(hear: Callable[[socket.socket], None]) -> Iterator[None]:
    """While inside, `hear` runs in a thread, with a socket that gets one byte, its number, for each signal."""
    told, tell = socket.socketpair()
    tell.setblocking(False)
    before = signal.set_wakeup_fd(tell.fileno(), warn_on_full_buffer=False)
    threading.Thread(target=hear, args=(told,), name="factorbus-signals", daemon=True).start()
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        tell.close()


def signalled(told: socket.socket) -> bool:
    """Wait for the next of our signals; False when there is nothing left to end.  Raises TimeoutError."""
    while number := told.recv(1):
        if number[0] in STOPPING:
            return True
    return False


def _see_to_it(told: socket.socket, stop: threading.Event, on_stop: Callable[[], None], exit_code: int | None) -> None:
    with told:
        if not signalled(told):
            return
        stop.set()
        on_stop()
        if signalled(told) and exit_code is not None:
            os._exit(exit_code)
