"""Other processes of ours: started with this interpreter, stopped in order, and never left behind.

A child runs with `--until-eof`: it stops when its standard input closes.  So it goes when we go, whatever ends us.
"""

import collections
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import IO

from factorbus.cli.output.exits import Stopped
from factorbus.proto.problems import Unavailable

READY = "ready "
# What is said before a process is started that computes.
STARTING = (
    "starting the solver process; kernels that are not compiled yet come first, once on a machine: one to five minutes"
)
_STOP_S = 20.0
_LONG_S = 3.0


class Child:
    """A running child: what it prints, and what it last said on standard error."""

    def __init__(self, name: str, arguments: Sequence[str], say: Callable[[str], None] | None = None) -> None:
        self.name = name
        self._say = say  # gets what it prints on standard error until it is ready, once that takes long
        self._started = time.monotonic()
        self._process = subprocess.Popen(
            # -P: a file of the folder we are in must not stand in for a library.
            [sys.executable, "-P", "-m", "factorbus.cli", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C is ours to handle: children are stopped in order
        )
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._said: collections.deque[str] = collections.deque(maxlen=20)
        self._readers = [
            threading.Thread(target=self._read, args=(self._process.stdout,), daemon=True),
            threading.Thread(target=self._listen, args=(self._process.stderr,), daemon=True),
        ]
        self._watchers: list[threading.Thread] = []
        for reader in self._readers:
            reader.start()

    @property
    def pid(self) -> int:
        """The process id."""
        return self._process.pid

    def line(self, timeout_s: float) -> str:
        """The next line it prints.  Raises Stopped when it ends or stays silent instead."""
        try:
            line = self._lines.get(timeout=timeout_s)
        except queue.Empty:
            raise Stopped("child_silent", f"the {self.name} process said nothing for {timeout_s:g} s") from None
        if line is None:
            raise self.died()
        return line.rstrip("\n")

    def ready(self, timeout_s: float) -> list[str]:
        """What follows `ready ` on the line that says so: endpoints, or a name.  Raises Stopped."""
        while not (line := self.line(timeout_s)).startswith(READY):
            pass
        self._say = None
        return line.removeprefix(READY).split()

    def output(self, timeout_s: float) -> str:
        """All it prints until it ends well.  Raises Stopped."""
        try:
            code = self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise Stopped("child_silent", f"the {self.name} process did not end within {timeout_s:g} s") from None
        if code != 0:
            raise self.died()
        return "".join(iter(self._lines.get, None))

    def ended(self) -> bool:
        """Whether it has ended, well or not."""
        return self._process.poll() is not None

    def when_ended(self, act: Callable[[], None]) -> None:
        """Call `act`, on a thread of its own, when it ends; `stop` waits until that is done."""

        def watch() -> None:
            self._process.wait()
            act()

        watcher = threading.Thread(target=watch, daemon=True)
        self._watchers.append(watcher)
        watcher.start()

    def died(self) -> Stopped:
        """How it ended, and the last that it said."""
        code = self._process.wait(_STOP_S)
        self._readers[1].join(_STOP_S)
        last = next((line for line in reversed(self._said) if line.strip()), "nothing")
        return Stopped("child_failed", f"the {self.name} process ended with exit code {code}; it said: {last}")

    def stop(self) -> None:
        """Close its standard input and wait; what does not go by itself is made to."""
        if self._process.stdin is not None:
            self._process.stdin.close()
        for act in (lambda: None, self._process.terminate, self._process.kill):
            act()
            try:
                self._process.wait(_STOP_S)
                break
            except subprocess.TimeoutExpired:
                continue
        # A thread still inside zenoh when the interpreter goes takes the process down with it.
        for thread in (*self._readers, *self._watchers):
            thread.join(_STOP_S)
        for stream in (self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()

    def _read(self, stream: IO[str]) -> None:
        for line in stream:
            self._lines.put(line)
        self._lines.put(None)

    def _listen(self, stream: IO[str]) -> None:
        for line in stream:
            self._said.append(line.rstrip("\n"))
            if self._say is not None and time.monotonic() - self._started > _LONG_S:
                self._say(self._said[-1])


@contextmanager
def child(name: str, *arguments: str, say: Callable[[str], None] | None = None) -> Iterator[Child]:
    """`factorbus ARGUMENTS` as a process of its own while inside."""
    process = Child(name, arguments, say)
    try:
        yield process
    finally:
        process.stop()


@contextmanager
def service(
    *options: str, say: Callable[[str], None] | None = None, timeout_s: float = 600.0
) -> Iterator[tuple[Child, str]]:
    """A solver process of our own on a free port of this machine, and its endpoint.

    Where the process ends meanwhile, an Unavailable that follows from it is turned into a Stopped that says so.
    say gets what it tells while it starts, if that takes long.  timeout_s allows for compiling every kernel.
    """
    with child("solver", "serve", "--listen", "tcp/127.0.0.1:0", "--until-eof", *options, say=say) as process:
        endpoint = process.ready(timeout_s)[0]
        try:
            yield process, endpoint
        except Unavailable:
            if process.ended():
                raise process.died() from None
            raise


@contextmanager
def gateway(
    endpoint: str, port: int, zenoh: str = "", client: str = "gateway", timeout_s: float = 60.0
) -> Iterator[str]:
    """A process that shows the maps at `endpoint` to browsers, and the address of its page."""
    known = ("--zenoh", zenoh, "--client", client) if zenoh else ()
    with child("gateway", "gateway", "--connect", endpoint, "--port", str(port), "--until-eof", *known) as process:
        yield process.ready(timeout_s)[0]


@contextmanager
def worker(endpoint: str, name: str, timeout_s: float = 600.0) -> Iterator[Child]:
    """A worker process joined to `endpoint`."""
    with child(name, "work", "--connect", endpoint, "--name", name, "--until-eof") as process:
        process.ready(timeout_s)
        yield process
