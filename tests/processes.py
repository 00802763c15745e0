"""Real processes for the tests: started, waited for by what they print, and always ended."""

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0
COMPILING_S = 300.0


class Process:
    """A Python process; its standard output comes line by line, its standard error goes to a file."""

    def __init__(self, log: Path, *arguments: str) -> None:
        self._log = log
        with log.open("w") as errors:
            self._popen = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=os.environ | {"PYTHONUNBUFFERED": "1"},
            )
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._popen.pid

    def ready(self) -> list[str]:
        """The words after `ready`: it may have to compile first."""
        return self.line("ready", COMPILING_S)

    def line(self, beginning: str, patience_s: float = PATIENCE_S) -> list[str]:
        """The words after `beginning` on the next line that begins so."""
        while True:
            try:
                line = self._lines.get(timeout=patience_s)
            except queue.Empty:
                raise AssertionError(f"no line {beginning!r} in {patience_s} s; {self._said()}") from None
            if line is None:
                raise AssertionError(f"ended before a line {beginning!r}; {self._said()}")
            if line.startswith(beginning):
                return line.removeprefix(beginning).split()

    def said(self, words: str, patience_s: float = COMPILING_S) -> str:
        """What follows `words` on the line of its standard error that has them, once it is there."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end and self._popen.poll() is None:
            for line in self._log.read_text().splitlines(keepends=True):
                if words in line and line.endswith("\n"):
                    return line.partition(words)[2].strip()
            time.sleep(0.05)  # a file tells nobody that it has grown
        raise AssertionError(f"no line with {words!r}; {self._said()}")

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self._popen.stdin is not None
        self._popen.stdin.write(line + "\n")
        self._popen.stdin.flush()

    def signal(self, number: signal.Signals) -> None:
        """Send a signal; one that stops it has done so, in all its threads, when this returns."""
        self._popen.send_signal(number)
        if number == signal.SIGSTOP:
            os.waitid(os.P_PID, self._popen.pid, os.WSTOPPED)

    def wait(self) -> int:
        """Its exit code, once it has ended."""
        return self._popen.wait(PATIENCE_S)

    def errors(self) -> str:
        """All it has written to its standard error."""
        return self._log.read_text()

    def end(self) -> None:
        """End it if it runs, whatever state it is in."""
        if self._popen.poll() is None:
            self._popen.kill()
            self._popen.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        for pipe in (self._popen.stdin, self._popen.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            self._lines.put(line.rstrip("\n"))
        self._lines.put(None)

    def _said(self) -> str:
        return f"its log ends: {self._log.read_text()[-2000:]}"


def within_patience(run: Callable[[], Any]) -> Any:
    """What `run` gives.  Raises TimeoutError when it takes longer than one event is waited for."""
    done: Future[Any] = Future()

    def go() -> None:
        try:
            done.set_result(run())
        except BaseException as problem:
            done.set_exception(problem)

    threading.Thread(target=go, daemon=True).start()
    return done.result(PATIENCE_S)


@contextlib.contextmanager
def processes(folder: Path) -> Iterator[Callable[..., Any]]:
    """A function that starts Python processes, all of which end with the context."""
    started: list[Process] = []

    def start(*arguments: str) -> Process:
        process = Process(folder / f"{len(started)}.log", *arguments)
        started.append(process)
        return process

    try:
        yield start
    finally:
        for process in started:
            process.end()
