"""`factorbus top`, in a terminal of its own: what is on the screen is what the service counts."""

import fcntl
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pyte
from processes import Process, processes

from factorbus.client import Draft, connect
from factorbus.simulate import manhattan

COMMAND = [sys.executable, "-m", "factorbus.cli", "top"]


class Terminal:
    """A terminal of 110 columns with a process in it."""

    def __init__(self, *arguments: str) -> None:
        self._ours, theirs = pty.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 130, 0, 0))
        environment = os.environ | {"TERM": "xterm-256color"}
        environment.pop("COLUMNS", None)  # tests side by side are told of a terminal that is not this one
        self.process = subprocess.Popen(
            [*COMMAND, *arguments], stdin=theirs, stdout=theirs, stderr=theirs, env=environment, start_new_session=True
        )
        os.close(theirs)
        self._screen = pyte.Screen(130, 30)
        self._stream = pyte.ByteStream(self._screen)

    def wait_for(self, shown: Callable[[list[str]], bool], patience_s: float = 60) -> list[str]:
        """The lines on the screen, once `shown` is content with them."""
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            lines = [line.rstrip() for line in self._screen.display]
            if shown(lines):
                return lines
            if select.select([self._ours], [], [], 1.0)[0]:
                self._stream.feed(os.read(self._ours, 65536))
        raise AssertionError("the screen never showed it:\n" + "\n".join(self._screen.display))

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(60)
        os.close(self._ours)


@contextmanager
def terminal(*arguments: str) -> Iterator[Terminal]:
    opened = Terminal(*arguments)
    try:
        yield opened
    finally:
        opened.close()


def row_of(lines: list[str], name: str) -> list[str]:
    return next((line.split() for line in lines if line.strip().startswith(name)), [])


def test_the_screen_follows_the_service(spawn: Callable[..., Process]) -> None:
    # Of its own: what others have on the folder's service would not leave room on the screen.
    (endpoint,) = spawn("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0", "--no-warm").ready()
    worker = spawn("-m", "factorbus.cli", "work", "--connect", endpoint, "--name", "worker7", "--no-warm")
    worker.ready()
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("topped") as joined:
        steps = list(manhattan(poses=60, seed=3))
        for step in steps[:20]:
            joined.insert(step.batch)
        with terminal("--connect", endpoint, "--every", "0.2") as screen:
            lines = screen.wait_for(lambda seen: row_of(seen, "topped")[2:3] == ["20"])
            assert lines[0].startswith(f"factorbus top   {endpoint}")
            for step in steps[20:]:
                joined.insert(step.batch)
            stats = joined.stats()
            # A frame comes in pieces: all that is wanted of it is waited for.
            lines = screen.wait_for(
                lambda seen: (
                    row_of(seen, "topped")[4:5] == ["60"]
                    and row_of(seen, joined.client)[1:3] == ["topped", "60"]
                    and row_of(seen, "worker7")[1:3] == ["1", "0"]
                )
            )
            row = row_of(lines, "topped")
            assert row[:5] == ["topped", stats["mode"], "60", str(stats["factors"]), "60"]
            assert f"{stats['chi2']:.6g}" in row
            os.killpg(screen.process.pid, signal.SIGINT)
            assert screen.process.wait(60) == 0


def test_a_service_that_goes_is_said_and_found_again(tmp_path) -> None:
    with processes(tmp_path) as start:
        service = start("-m", "factorbus.cli", "serve", "--listen", "tcp/127.0.0.1:0", "--no-warm", "--map", "here")
        (endpoint,) = service.ready()
        with terminal("--connect", endpoint, "--every", "0.2") as screen:
            screen.wait_for(lambda seen: bool(row_of(seen, "here")))
            service.signal(signal.SIGTERM)
            service.wait()
            screen.wait_for(lambda seen: "nobody answers" in seen[0])
            start("-m", "factorbus.cli", "serve", "--listen", endpoint, "--no-warm", "--map", "again").ready()
            screen.wait_for(lambda seen: bool(row_of(seen, "again")))


def test_who_has_left_is_no_longer_listed(endpoint: str) -> None:
    with connect(endpoint, client="stayer", timeout_s=60) as staying, staying.map("departed") as stayed:
        stayed.insert(Draft().point2("l1", (1.0, 2.0)).prior_point2("l1", (1.0, 2.0), sigmas=(1.0, 1.0)))
        with connect(endpoint, client="leaver", timeout_s=60) as bus, bus.map("departed") as joined:
            joined.insert(Draft().point2("l2", (1.0, 2.0)).prior_point2("l2", (1.0, 2.0), sigmas=(1.0, 1.0)))
            joined.insert(Draft().point2("l3", (1.0, 2.0)).prior_point2("l3", (1.0, 2.0), sigmas=(1.0, 1.0)))
            assert stayed.clients() >= {stayed.client, joined.client}
        looked = [*COMMAND, "--connect", endpoint, "--every", "0.1"]
        shown = subprocess.run([*looked, "--once"], capture_output=True, text=True, timeout=60, check=True).stdout
        told = subprocess.run([*looked, "--json"], capture_output=True, text=True, timeout=60, check=True).stdout
        assert row_of(shown.splitlines(), stayed.client)[:3] == [stayed.client, "departed", "1"]
        assert "leaver" not in shown
        assert re.search(r"\d+ clients? gone, after \d+ inserts?", shown)
        mine = {
            row["name"]: (row["here"], row["inserts"])
            for row in json.loads(told)["clients"]
            if row["map"] == "departed"
        }
        assert mine == {stayed.client: (True, 1), joined.client: (False, 2)}


def test_where_there_is_no_terminal_it_says_what_to_take_instead(endpoint: str) -> None:
    ran = subprocess.run(
        [*COMMAND, "--connect", endpoint],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (ran.returncode, ran.stdout) == (2, "")
    assert "--once" in ran.stderr


def test_once_as_a_document(endpoint: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("documented") as joined:
        for step in manhattan(poses=10, seed=3):
            joined.insert(step.batch)
        ran = subprocess.run(
            [*COMMAND, "--connect", endpoint, "--json", "--every", "0.1"],
            capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
    seen = json.loads(ran.stdout)
    mine = next(row for row in seen["maps"] if row["name"] == "documented")
    assert (mine["variables"], mine["steps_per_s"], mine["step_ms"], mine["refused"]) == (10, 0.0, None, 0)
