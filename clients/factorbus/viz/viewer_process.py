"""A Rerun viewer, or what serves one to browsers, as a process of its own that listens at one address and ends with us.

Rerun's Python library listens on every address of the machine; its program takes the address, so that is what is run.
`python -m factorbus.viz.viewer_process` runs it, and ends it when standard input closes: whatever ends us, it goes too.
"""

import os
import socket
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

from factorbus.proto.ports import check_free

_START_S, _STOP_S, _LOOK_S = 30.0, 10.0, 0.05
EVERYWHERE = ("0.0.0.0", "::")


class Viewer:
    """A viewer that takes recordings at `host`:`data_port`; with a web port, for browsers, else a window."""

    def __init__(self, host: str, data_port: int, web_port: int | None = None) -> None:
        """Start it and wait until it takes recordings.  Raises RuntimeError, PortTaken, CannotListen."""
        self._host, self._data_port, self._web_port = host, data_port, web_port
        self._process: subprocess.Popen[bytes] | None = None
        if web_port is None and _answers(host, data_port):
            return  # a viewer runs already, and gets this map as well
        for port in (data_port, *(() if web_port is None else (web_port,))):
            check_free(f"{host}:{port}", host, port)
        arguments = ["--bind", host, "--port", str(data_port)]
        if web_port is None:
            arguments += ["--expect-data-soon"]
        else:
            page = f"http://{_seen_at(host)}:{web_port}"
            arguments += ["--serve-web", "--web-viewer-port", str(web_port), "--cors-allow-origin", page]
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "factorbus.viz.viewer_process", *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self._wait()

    @property
    def data(self) -> str:
        """Where recordings go, as Rerun writes it."""
        return f"rerun+http://{_bracketed(_seen_at(self._host))}:{self._data_port}/proxy"

    @property
    def page(self) -> str:
        """The address for browsers."""
        data = self.data.replace(":", "%3A").replace("/", "%2F").replace("+", "%2B")
        return f"http://{_bracketed(_seen_at(self._host))}:{self._web_port}/?url={data}"

    def stop(self) -> None:
        """End it, unless it is a window of this display: that stays for its user."""
        if self._process is None or self._process.stdin is None or self._process.stderr is None:
            return
        self._process.stdin.close()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(_STOP_S)
        self._process.stderr.close()

    def _wait(self) -> None:
        process = self._process
        end = time.monotonic() + _START_S
        ports = [port for port in (self._data_port, self._web_port) if port is not None]
        while process is not None and not all(_answers(self._host, port) for port in ports):
            if process.poll() is not None:
                said = process.stderr.read().decode(errors="replace").splitlines() if process.stderr else []
                raise RuntimeError(next((line for line in reversed(said) if line.strip()), "it ended at once"))
            if time.monotonic() > end:
                self.stop()
                raise RuntimeError(f"nothing listens at {self._host}:{ports[-1]} after {_START_S:g} s")
            time.sleep(_LOOK_S)  # a port that nobody listens at yet tells nobody when that changes


def _seen_at(host: str) -> str:
    """How this machine reaches what listens at `host`."""
    return "127.0.0.1" if host in EVERYWHERE else host


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _answers(host: str, port: int) -> bool:
    try:
        socket.create_connection((_seen_at(host), port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _program() -> str:
    """Rerun's own program.  Raises RuntimeError."""
    found = find_spec("rerun_cli")
    program = Path(found.origin).parent / "rerun" if found and found.origin else None
    if program is None or not program.is_file():
        raise RuntimeError("rerun-sdk is installed without its viewer; pip install --force-reinstall rerun-sdk")
    return str(program)


def main(arguments: list[str]) -> int:
    """Run Rerun's program with `arguments` until it ends or standard input closes; returns its exit code."""
    program = subprocess.Popen(
        [_program(), *arguments], stdin=subprocess.DEVNULL, env=os.environ | {"RERUN_APP_ONLY": "true"}
    )

    def end_with_our_parent() -> None:
        while os.read(0, 4096):
            pass
        program.terminate()

    threading.Thread(target=end_with_our_parent, daemon=True).start()
    return program.wait()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
