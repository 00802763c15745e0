"""A network under a test's control: two namespaces with a wire between them, or a relay of TCP connections.

Between the namespaces lie two TUN devices, whose packets a thread here carries over: late, or not at all.  So they are
lost as on a bad radio link, whatever queueing disciplines the kernel has.  Where namespaces are not permitted, a relay
of connections is what remains: it can hold bytes back, let connections hang, and break them.
"""

import contextlib
import fcntl
import heapq
import os
import random
import select
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable

import pytest

_TUNSETIFF = 0x400454CA
_IFF_TUN, _IFF_NO_PI = 1, 0x1000
SERVICE, CLIENT = "10.77.0.1", "10.77.0.2"


class Wire:
    """Two namespaces; `run(end)` are the words before a command that runs it in one.  Skips where not permitted."""

    def __init__(self) -> None:
        self._names = [f"fb{os.getpid()}{end}" for end in "sc"]
        self._devices: list[int] = []
        self.loss, self.delay_s, self.jitter_s, self.cut = 0.0, 0.0, 0.0, False
        self.carried = self.dropped = 0
        self._ending = threading.Event()
        try:
            for name, here, there in zip(self._names, (SERVICE, CLIENT), (CLIENT, SERVICE), strict=True):
                self._make(name, here, there)
        except (OSError, subprocess.CalledProcessError) as error:
            self.close()
            pytest.skip(f"no network namespaces here: {getattr(error, 'stderr', '') or error}")
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def run(self, end: str) -> tuple[str, ...]:
        """What to put before the arguments of a Python process, so that it is at `end` (service or client)."""
        return (__file__, self._names[end == "client"])

    def close(self) -> None:
        """Take it down."""
        self._ending.set()
        if self._devices and hasattr(self, "_thread"):
            self._thread.join(10)
        for device in self._devices:
            os.close(device)
        for name in self._names:
            subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)

    def _make(self, name: str, here: str, there: str) -> None:
        _ip("netns", "add", name)
        device = os.open("/dev/net/tun", os.O_RDWR | os.O_CLOEXEC)
        self._devices.append(device)
        fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH", name.encode(), _IFF_TUN | _IFF_NO_PI))
        os.set_blocking(device, False)
        _ip("link", "set", "dev", name, "netns", name)
        for words in (
            ("addr", "add", here, "peer", there, "dev", name),
            ("link", "set", "dev", name, "up"),
            ("link", "set", "dev", "lo", "up"),
        ):
            _ip("-n", name, *words)

    def _carry(self) -> None:
        chance, late, order = random.Random(11), list[tuple[float, int, int, bytes]](), 0
        while not self._ending.is_set():
            wait_s = max(min(late[0][0] - time.monotonic(), 0.05), 0.0) if late else 0.05
            for device in select.select(self._devices, [], [], wait_s)[0]:
                with contextlib.suppress(BlockingIOError):
                    packet = os.read(device, 65536)
                    if self.cut or chance.random() < self.loss:
                        self.dropped += 1
                        continue
                    at = time.monotonic() + self.delay_s + chance.uniform(0, self.jitter_s)
                    other = self._devices[device == self._devices[0]]
                    order += 1
                    heapq.heappush(late, (at, order, other, packet))
            while late and late[0][0] <= time.monotonic():
                _, _, device, packet = heapq.heappop(late)
                with contextlib.suppress(OSError):  # the queue of a device is full: a packet is lost, as anywhere
                    os.write(device, packet)
                    self.carried += 1


class Relay:
    """Connections to `port`, carried to a service's port: bytes may be late, held back, or the connections broken."""

    def __init__(self, port: int) -> None:
        self._to = port
        self.delay_s, self.carried_bytes = 0.0, 0
        self._open = threading.Event()
        self._open.set()
        self._pairs: list[tuple[socket.socket, socket.socket]] = []
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._ending, self._threads = False, list[threading.Thread]()
        self._start(self._accept)

    def hold(self) -> None:
        """From now on nothing passes, and nobody is told."""
        self._open.clear()

    def release(self) -> None:
        """What was held back passes now."""
        self._open.set()

    def break_all(self) -> None:
        """Every connection is reset."""
        pairs, self._pairs = self._pairs, []
        for pair in pairs:
            for each in pair:
                with contextlib.suppress(OSError):
                    each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    each.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Relay no more."""
        self._ending = True
        self._open.set()
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes who accepts
        self.break_all()
        for thread in self._threads:
            thread.join(10)
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while not self._ending:
                near, _ = self._listener.accept()
                self._open.wait()
                try:
                    far = socket.create_connection(("127.0.0.1", self._to))
                except OSError:
                    near.close()
                    continue
                self._pairs.append((near, far))
                self._start(self._pass_both, near, far)

    def _pass_both(self, near: socket.socket, far: socket.socket) -> None:
        back = threading.Thread(target=self._pass, args=(far, near), daemon=True)
        back.start()
        self._pass(near, far)
        back.join()
        near.close()
        far.close()

    def _start(self, what: Callable[..., None], *arguments: socket.socket) -> None:
        self._threads.append(threading.Thread(target=what, args=arguments, daemon=True))
        self._threads[-1].start()

    def _pass(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                if self.delay_s:
                    time.sleep(self.delay_s)  # what it is for
                self._open.wait()
                sink.sendall(data)
                self.carried_bytes += len(data)
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True, text=True)


if __name__ == "__main__":  # wire.py NAMESPACE ARGUMENT...: Python with these arguments, in the namespace
    os.execvp("ip", ["ip", "netns", "exec", sys.argv[1], sys.executable, *sys.argv[2:]])
