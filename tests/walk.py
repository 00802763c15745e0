"""Walks a document as its reader would: every block of code in it is run, in order, in one folder.

    bash     run as it stands.  A command that stays, such as `factorbus serve`, runs until the document ends, or until
             the document starts it again.  Of `make TARGET` it is only seen that there is such a target.
    python   run as a program.
    console  each line after `$ ` is run as above; the lines below it are compared with what it prints.
    text     what the block before it printed: every line of it, with … for anything, and any number for a number.

What is said to listen or answer at the usual addresses does so at free ports instead, and loads its kernels when it
needs them.
"""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SCRIPTS = Path(sys.executable).parent
ENDPOINT, PAGE, METRICS = "tcp/127.0.0.1:7447", "http://127.0.0.1:8080", "127.0.0.1:9464"
LANGUAGES = {"bash", "console", "python", "text"}
# Commands that stay, with what lets them listen at any free port and begin at once.
_STAYING = {"serve": ["--no-warm", "--listen", "tcp/127.0.0.1:0"], "work": ["--no-warm"], "gateway": ["--port", "0"]}
_PATIENCE_S = 100.0
_NUMBER = re.compile(r"(?<![A-Za-z])[-+]?\d[\d,]*(?:\.\d*)?(?:e[-+]?\d+)?")


def blocks(document: str) -> list[tuple[str, str]]:
    """(language, text) of the fenced blocks of a document, in order."""
    return re.findall(r"^```(\w+)\n(.*?)^```$", (ROOT / document).read_text(encoding="utf-8"), re.M | re.S)


def walk(document: str, folder: Path) -> str:
    """Run all of it in `folder`; gives all that was printed.  Raises AssertionError, with what was said."""
    said, everything = "", []
    with walker(folder) as step:
        for language, text in blocks(document):
            assert language in LANGUAGES, f"{document}: a block of {language!r} would not be run"
            if language == "text":
                agrees(text, said)
            else:
                said = step(language, text)
                everything.append(said)
    return "".join(everything)


@contextmanager
def walker(folder: Path) -> Iterator["_Walk"]:
    """A function of (language, text) that runs a block and gives what it printed."""
    with ExitStack() as stack:
        yield _Walk(folder, stack)


def agrees(wanted: str, said: str) -> None:
    """Every line of `wanted` is in `said`, in that order."""
    rest = [_plain(line) for line in said.splitlines()]
    for line in filter(None, map(_plain, wanted.splitlines())):
        form = ".*".join(re.escape(_NUMBER.sub("0", part)) for part in line.split("…"))
        at = next((i for i, each in enumerate(rest) if re.fullmatch(form, _NUMBER.sub("0", each))), None)
        assert at is not None, f"wanted a line {line!r}; it said:\n{said}"
        rest = rest[at + 1 :]


def _plain(line: str) -> str:
    return " ".join(line.split()).replace("[ ", "[").replace(" ]", "]")


class _Walk:
    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self._folder, self._stack = folder, stack
        self._running: dict[str, ExitStack] = {}
        self._places = {METRICS: f"127.0.0.1:{_free_port()}"}

    def __call__(self, language: str, text: str) -> str:
        if language == "console":
            return self._session(text)
        for usual, real in self._places.items():
            text = text.replace(usual, real)
        if language == "python":
            return self._run([sys.executable, "-c", text])
        words = text.split()
        if words[0] == "make":
            return self._run(["make", "--dry-run", "--directory", str(ROOT), *words[1:]])
        if words[0] == "factorbus" and words[1] in _STAYING:
            return self._start(words[1], text.strip())
        return self._run(["bash", "-euo", "pipefail", "-c", text])

    def _session(self, text: str) -> str:
        said = ""
        for command, printed in re.findall(r"^\$ (.*)\n((?:(?!\$ ).*\n)*)", text, re.M):
            said = self("bash", command)
            agrees(printed, said)
        return said

    def _environment(self) -> dict[str, str]:
        there = {"FACTORBUS_ENDPOINT": self._places[ENDPOINT]} if ENDPOINT in self._places else {}
        return os.environ | there | {"PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}"}

    def _run(self, arguments: list[str]) -> str:
        ran = subprocess.run(
            arguments, cwd=self._folder, env=self._environment(), capture_output=True, text=True,
            timeout=_PATIENCE_S, check=False,
        )  # fmt: skip
        assert ran.returncode == 0, f"{arguments} ended with {ran.returncode}\n{ran.stdout}\n{ran.stderr}"
        return ran.stdout

    def _start(self, name: str, command: str) -> str:
        """Start a command that stays, in place of one that was started by the same name."""
        if name in self._running and name != "work":
            self._running.pop(name).close()
        own = self._running[name] = self._stack.enter_context(ExitStack())
        arguments = ["bash", "-c", f'exec {command} "$@"', "walk", *_STAYING[name], "--until-eof"]
        process = own.enter_context(
            subprocess.Popen(
                arguments, cwd=self._folder, env=self._environment(), stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, text=True,
            )
        )  # fmt: skip
        assert process.stdout is not None
        ready = process.stdout.readline()
        assert ready.startswith("ready "), f"{command} said {ready!r} and ended with {process.poll()}"
        own.callback(_ended, process)
        if name != "work":
            self._places[{"serve": ENDPOINT, "gateway": PAGE}[name]] = ready.split()[1]
        return ready


def _ended(process: "subprocess.Popen[str]") -> None:
    """Stopped in order: by the end of its standard input."""
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(_PATIENCE_S) == 0


def _free_port() -> int:
    from browser import free_port

    return free_port()
