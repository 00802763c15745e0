"""Whatever is asked of the gateway, the answer is a documented one, and its log has no traceback."""

import contextlib
import json
import random
import signal
import socket
from collections.abc import Callable
from urllib.parse import urlsplit

import numpy as np
import pytest
from processes import Process

from factorbus.client import Draft, connect
from factorbus.gateway.documents import Document
from factorbus.proto.problems import BadSymbol
from factorbus.proto.symbols import MAX_KEY, MIN_KEY, parse_symbol

pytest.importorskip("starlette")

# How long a request that may not be complete is waited for, and one that is.
REQUESTS, PATIENCE_S, ANSWER_S = 600, 1.0, 60.0
# What the gateway may answer with: done, wrong, not there, not that way, refused, too long, away.
DOCUMENTED = {200, 304, 400, 404, 405, 409, 414, 431, 503}
UPGRADE = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {key}\r\n"
KEY = "dGhlIHNhbXBsZSBub25jZQ=="
PIECES = (
    "api", "maps", "fuzzed", "nowhere", "estimate", "graph", "stats", "closures", "ellipses", "variables", "export",
    "live", "edits", "session", "edges", "factors",
    "page", "main.js", "x0", "x1", "l1", "7", "x" + "9" * 17, "x" + "9" * 5000, "9" * 4301, "x-1", "é1", "..",
    ".", "", "%00", "%2e%2e", "%2F", "%ff%fe", "%", "%zz", "a" * 64, "a" * 65, "a" * 300, "fuzzed%20", "*", "**", "$*",
    "fuzzed?x", "%F0%9F%98%80", "\u00e9", "~", "index.html", "CON", "x0%0d%0aSet-Cookie:a",
)  # fmt: skip
QUERIES = (
    "", "?", "?format=g2o", "?format=tum", "?format=kitti", "?format=pyfg", "?format=jrl", "?format=", "?format=png",
    "?format=%00", "?format=%ff",
    "?format=g2o&format=tum", "?" + "a" * 5000, "?format=" + "g" * 3000, "?%=%", "?a[]=1", "?format=%0d%0aX:%20y",
)  # fmt: skip
HEADERS = (
    "Host: 127.0.0.1", "Host: localhost:{port}", "Host: evil.example", "Host: ", "Host: [::1", "Host: 127.0.0.1:x",
    "Host: \u00e9", "Origin: http://[", "Origin: null", "Origin: http://127.0.0.1:{port}", "Origin: ://", "Accept: */*",
    "Range: bytes=0-3", "Range: bytes=9-1", "Range: bytes=-", "Range: bytes=" + "0-1," * 200, "Range: octets=\u00b2",
    "If-None-Match: *", "If-Modified-Since: never", "If-Range: \u0663", "Content-Length: -1", "Content-Length: 5",
    "Transfer-Encoding: chunked", "Transfer-Encoding: x", "Expect: 100-continue", "Cookie: " + "c" * 3000, "X: \x7f",
    "Accept-Encoding: gzip", "Connection: close", "no colon", ": empty", "Upgrade: websocket", "Upgrade: h2c",
)  # fmt: skip
METHODS = ("GET", "GET", "GET", "GET", "HEAD", "POST", "PUT", "DELETE", "OPTIONS", "TRACE", "CONNECT", "PATCH", "BREW")
FRAMES = (
    b"\x81\x82\0\0\0\0hi", b"\x82\x81\0\0\0\0\xff", b"\x81\x81\0\0\0\0\xff", b"\x88\x80\0\0\0\0",
    b"\x88\x81\0\0\0\0\x03",
    b"\x88\x82\0\0\0\0\xff\xff", b"\x89\x80\0\0\0\0", b"\x8a\x80\0\0\0\0", b"\x81\x02hi", b"\xf1\x80\0\0\0\0",
    b"\x81\xff\x7f\xff\xff\xff\xff\xff\xff\xff\0\0\0\0", b"\x80\x80\0\0\0\0", b"\x83\x80\0\0\0\0", b"\0" * 40,
)  # fmt: skip


def request(numbers: random.Random, port: int) -> bytes:
    """One, mostly nearly right."""
    path = "/" + "/".join(numbers.choice(PIECES) for _ in range(numbers.randrange(6)))
    if numbers.random() < 0.7:
        path = f"/api/maps/{numbers.choice(PIECES)}/{numbers.choice(PIECES)}"
        path += f"/{numbers.choice(PIECES)}" if numbers.random() < 0.4 else ""
    if numbers.random() < 0.3:
        path = "/api/maps/fuzzed/" + numbers.choice(("estimate", "graph", "stats", "closures", "ellipses", "export"))
    head = f"{numbers.choice(METHODS)} {path}{numbers.choice(QUERIES)} HTTP/1.1\r\n"
    if numbers.random() < 0.8:
        head += f"Host: 127.0.0.1:{port}\r\n"
    for _ in range(numbers.choice((0, 1, 1, 2, 4))):
        head += numbers.choice(HEADERS).replace("{port}", str(port)) + "\r\n"
    if numbers.random() < 0.3:
        head += UPGRADE.format(key=numbers.choice((KEY, "", "short", KEY * 3)))
    data = (head + "\r\n").encode(numbers.choice(("utf-8", "latin-1")), "replace")
    if numbers.random() < 0.03:
        data = bytearray(data)
        data[numbers.randrange(len(data))] = numbers.randrange(256)
    return bytes(data)


def answer(port: int, data: bytes, frames: bytes = b"", patience_s: float = ANSWER_S) -> int | None:
    """Its status; None: the connection was closed without one, or there was none in that time."""
    with socket.create_connection(("127.0.0.1", port), timeout=60) as line:
        line.sendall(data)
        line.settimeout(patience_s)
        try:
            first = line.recv(64)
            line.settimeout(PATIENCE_S)
            if first.startswith(b"HTTP/1.1 101") and frames:
                line.sendall(frames)
                with contextlib.suppress(TimeoutError):  # half a frame has no answer
                    line.recv(1 << 16)
            if first:
                line.shutdown(socket.SHUT_WR)
        except OSError:
            return None
    return int(first.split()[1]) if first.startswith(b"HTTP/1.1 ") else None


@pytest.mark.timeout(600)
def test_fuzzed_requests_get_documented_answers_and_leave_no_traceback(
    endpoint: str, spawn: Callable[..., Process], record_property: Callable[[str, object], None]
) -> None:
    seed = random.randrange(2**32)
    record_property("seed", seed)
    print("seed", seed)
    numbers = random.Random(seed)
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("fuzzed") as joined:
        joined.insert(Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1", (1, 0, 0)).between_se2(
            "x0", "x1", (1, 0, 0), sigmas=(0.1, 0.1, 0.1)))  # fmt: skip
        process = spawn("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0")
        (address,) = process.ready()
        port = urlsplit(address).port
        assert port is not None
        seen: dict[int | None, int] = {}
        for _ in range(REQUESTS):
            data = request(numbers, port)
            # A body that was announced never comes: not for the server to answer before.
            if b"content-length: 5" in data.lower() or b"transfer-encoding" in data.lower():
                data += b"5\r\nabcde\r\n0\r\n\r\n"
            status = answer(port, data, numbers.choice(FRAMES), PATIENCE_S)
            seen[status] = seen.get(status, 0) + 1
            # 100 is what a request gets that expects to be told to go on, before its answer.
            assert status in DOCUMENTED | {100, 101, 206, 416, 426, 403, None}, data
        live = f"GET /api/maps/fuzzed/live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n{UPGRADE.format(key=KEY)}"
        for frames in FRAMES:
            for origin in ("", "Origin: http://[\r\n", "Origin: http://evil.example\r\n"):
                assert answer(port, f"{live}{origin}\r\n".encode(), frames) == 101
        assert answer(port, f"GET /api/maps HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode()) == 200
        process.signal(signal.SIGTERM)
        assert process.wait() == 0
    record_property("answers", {str(status): count for status, count in seen.items()})
    log = process.errors()
    assert "Traceback" not in log, log[log.index("Traceback") - 500 :][:4000]
    assert seen[200] > 10
    assert seen[404] > 10


@pytest.mark.parametrize("browser", ["reads nothing", "sends half a request", "sends an upgrade that is none"])
def test_it_stops_with_a_browser_that(endpoint: str, spawn: Callable[..., Process], browser: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("large") as joined:
        if "x0" not in joined.estimate:
            joined.insert(row(3000))
        process = spawn("-m", "factorbus.cli", "gateway", "--connect", endpoint, "--port", "0")
        port = urlsplit(process.ready()[0]).port
        assert port is not None
        host = f"Host: 127.0.0.1:{port}\r\n"
        upgrade = f"GET /api/maps/large/live HTTP/1.1\r\n{host}{UPGRADE.format(key=KEY)}"
        asked = {
            "reads nothing": f"GET /api/maps/large/estimate HTTP/1.1\r\n{host}\r\n" * 100,
            "sends half a request": upgrade,
            "sends an upgrade that is none": upgrade + "X: y\r\n" * 300 + "\r\n",
        }
        with contextlib.ExitStack() as lines:
            for sent in (f"{upgrade}\r\n", asked[browser]):
                line = lines.enter_context(socket.socket())
                line.settimeout(ANSWER_S)
                line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)  # what is sent soon stays where it is
                line.connect(("127.0.0.1", port))
                line.sendall(sent.encode())
                if "half" not in browser:
                    assert line.recv(12) in (b"HTTP/1.1 101", b"HTTP/1.1 200", b"HTTP/1.1 400")
            for _ in range(20):  # by then as much was answered as there is room for
                assert answer(port, f"GET /api/maps/large/estimate HTTP/1.1\r\n{host}\r\n".encode()) == 200
            process.signal(signal.SIGTERM)
            assert process.wait() == 0
    assert "Traceback" not in process.errors()


def row(poses: int) -> Draft:
    """A robot that drives straight on."""
    draft = Draft().se2("x0", (0, 0, 0), fixed=True)
    for i in range(1, poses):
        draft.se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", (1, 0, 0), sigmas=(0.1, 0.1, 0.1))
    return draft


@pytest.mark.parametrize(
    "text", ["9" * 5000, "x" + "9" * 5000, str(MAX_KEY + 1), str(MIN_KEY - 1), "-" + "9" * 5000, "x" + "9" * 18]
)
def test_numbers_too_long_to_read_are_no_keys(text: str) -> None:
    with pytest.raises(BadSymbol) as raised:
        parse_symbol(text)
    assert len(raised.value.message) < 300
    assert [parse_symbol(str(key)) for key in (-5, MIN_KEY, MAX_KEY)] == [-5, MIN_KEY, MAX_KEY]
    assert parse_symbol("x" + "0" * 6000 + "12") == parse_symbol("x12")


def test_what_is_no_number_is_null_in_a_document() -> None:
    made = Document({"a": [1.0, np.inf, {"b": float("nan")}], "c": -0.5})
    assert json.loads(made.body) == {"a": [1.0, None, {"b": None}], "c": -0.5}
