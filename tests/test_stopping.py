"""SIGTERM at any moment sets the event: while the main thread waits, takes the event's lock, or does something else."""

import signal
import subprocess
import sys

import pytest

from factorbus.stopping import stop_on_signals

# The signal comes at the nth line of the standard library that waiting for the event runs, for every n.
ROUNDS = """
import os, signal, sys, threading
from factorbus.stopping import stop_on_signals

def at_line(wanted):
    seen = 0

    def trace(frame, event, _):
        nonlocal seen
        if event == "line" and frame.f_code.co_filename == threading.__file__:
            seen += 1
            if seen == wanted:
                os.kill(os.getpid(), signal.SIGTERM)
        return trace

    return trace

for n in range(1, 60):
    with stop_on_signals() as stop:
        sys.settrace(at_line(n))
        while not stop.wait(0.001):
            pass
        sys.settrace(None)
print("all")
"""
DEAF = """
import time
from factorbus.stopping import stop_on_signals

with stop_on_signals(lambda: print("told", flush=True), exit_code=7):
    print("ready", flush=True)
    time.sleep(1000)  # it does not look at the event
"""


def test_no_moment_is_a_bad_one() -> None:
    ran = subprocess.run([sys.executable, "-c", ROUNDS], capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, "all\n", "")


def test_the_second_signal_ends_a_process_that_does_not_come_to_look() -> None:
    with subprocess.Popen([sys.executable, "-c", DEAF], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            process.send_signal(signal.SIGINT)
            assert process.stdout.readline() == "told\n"
            process.send_signal(signal.SIGTERM)
            assert process.wait(60) == 7
        finally:
            process.kill()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_afterwards_all_is_as_it_was(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stop_on_signals() as stop:
        signal.raise_signal(number)
        assert stop.wait(60)
    assert signal.getsignal(number) == before
    assert signal.set_wakeup_fd(-1) == -1
