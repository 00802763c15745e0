"""A command that is interrupted ends, even where the interrupt is lost."""

import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from factorbus.cli.output.exits import INTERRUPTED
from factorbus.cli.process.stopping import interrupt_on_sigterm
from factorbus.stopping import signalled

# What the signals raise is lost.
DEAF = """
import signal, sys
from factorbus.cli.process.stopping import interrupt_on_sigterm

with interrupt_on_sigterm(float(sys.argv[1])):
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    print("ready", flush=True)
    while True:
        signal.pause()
"""


@contextmanager
def deaf(grace_s: float) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", DEAF, str(grace_s)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        try:
            yield process
        finally:
            process.kill()


# As if Ctrl-C were pressed while the first of our modules is imported.
EARLY = """
import builtins, os, signal, sys
from factorbus.cli.entry import main

imported = builtins.__import__

def interrupted(name, *rest):
    if name.startswith("factorbus"):
        os.kill(os.getpid(), signal.SIGINT)
    return imported(name, *rest)

if "ignored" in sys.argv:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
builtins.__import__ = interrupted
sys.argv = ["factorbus", "--version"]
print("ended with", main())
"""


def test_one_that_is_interrupted_before_all_is_imported_says_so_and_no_more() -> None:
    ran = subprocess.run([sys.executable, "-c", EARLY], capture_output=True, text=True, timeout=60, check=False)
    assert (ran.returncode, ran.stdout, ran.stderr) == (INTERRUPTED, "", "interrupted\n")


def test_where_interrupts_are_ignored_they_stay_so() -> None:
    ran = subprocess.run(
        [sys.executable, "-c", EARLY, "ignored"], capture_output=True, text=True, timeout=60, check=False
    )
    assert ran.stdout.endswith("ended with 0\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_does_not_end_by_itself_is_ended(number: int) -> None:
    with deaf(0.1) as process:
        process.send_signal(number)
        _, error = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED
    assert error.endswith("interrupted\n")


def test_the_second_signal_is_final() -> None:
    with deaf(1000.0) as process:
        process.send_signal(signal.SIGINT)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == INTERRUPTED


def test_other_signals_are_others() -> None:
    told, tell = socket.socketpair()
    with told, tell:
        told.setblocking(False)
        tell.send(bytes([signal.SIGUSR1, signal.SIGTERM, signal.SIGWINCH]))
        assert signalled(told)
        with pytest.raises(BlockingIOError):
            signalled(told)
        tell.close()
        assert not signalled(told)


def test_afterwards_all_is_as_it_was() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), interrupt_on_sigterm():
        signal.raise_signal(signal.SIGTERM)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before
    assert signal.set_wakeup_fd(-1) == -1
