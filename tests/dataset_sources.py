"""The public sources of the data sets written back from the converted files, and a server that serves them."""

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

# The numbers of the landmarks in the source of citytrees10000, in the order in which they are first seen.
_TREES = (
    11, 32, 41, 64, 22, 26, 15, 85, 96, 63, 84, 65, 3, 13, 50, 2, 34, 76, 23, 82, 36, 0, 27, 7, 87, 29, 67, 88, 5, 44,
    80, 86, 46, 48, 57, 47, 20, 58, 25, 42, 45, 77, 30, 56, 54, 24, 75, 8, 38, 49, 97, 21, 94, 10, 70, 60, 4, 91, 90,
    68, 16, 93, 43, 31, 72, 18, 89, 52, 17, 9, 51, 35, 39, 12, 78, 74, 92, 71, 69, 79, 98, 53, 62, 99, 14, 37, 81, 66,
    1, 59, 28, 61, 40, 19, 73, 6, 33, 95, 83, 55,
)  # fmt: skip

# Roots of information, as the sources have them.
_MANHATTAN = ("44.72135955", "0", "0", "44.72135955", "0", "44.72135955")
_CITY = ("50", "0", "0", "50", "0", "100")
_PARK = ("100", "0", "0", "500", "0", "500")

Rows = Sequence[Sequence[str]]


def written_back(name: str, folder: Path) -> bytes:
    """The source of data set `name` as it must have been, from the converted file in `folder`."""
    rows = [line.split() for line in (folder / f"{name}.g2o").read_text().splitlines()]
    return "".join(f"{' '.join(row)}\n" for row in _WAYS[name](rows)).encode()


def _manhattan(rows: Rows) -> Rows:
    """iSAM, the odometry edge last within its pose."""
    by_pose: dict[int, list[Sequence[str]]] = {}
    for row in rows:
        by_pose.setdefault(int(row[2]), []).append(row)
    ordered = [row for pose in sorted(by_pose) for row in (*by_pose[pose][1:], by_pose[pose][0])]
    return [("ODOMETRY", *row[1:6], *_MANHATTAN) for row in ordered]


def _city(rows: Rows) -> Rows:
    return [("EDGE2", *row[1:6], *_CITY) for row in rows]


def _victoria(rows: Rows) -> Rows:
    """Poses and landmarks in one numbering."""
    return [
        ("ODOMETRY", *row[1:6], *_PARK)
        if row[0] == "EDGE_SE2"
        else ("LANDMARK", *row[1:5], "1.581139", "0", "1.581139")
        for row in rows
    ]


def _city_trees(rows: Rows) -> Rows:
    """Poses and landmarks numbered apart."""
    poses: dict[str, str] = {}
    trees: dict[str, str] = {}
    back = []
    for record, i, j, *rest in rows:
        poses.setdefault(i, str(len(poses)))
        if record == "EDGE_SE2":
            poses.setdefault(j, str(len(poses)))
            back.append(("EDGE2", poses[i], poses[j], *rest[:3], *_CITY))
        else:
            if j not in trees:
                trees[j] = str(_TREES[len(trees)])
            back.append(("LANDMARK", poses[i], trees[j], *rest[:2], "10", "0", "10"))
    return back


def _killian(rows: Rows) -> Rows:
    """A pose, then its edges, the information in HOG-Man's order: xx xy yy tt xt yt."""
    back = [("VERTEX", *row[1:]) for row in rows if row[0] == "VERTEX_SE2"]
    back += [("EDGE", *row[1:8], row[9], row[11], row[8], row[10]) for row in rows if row[0] == "EDGE_SE2"]
    return sorted(back, key=lambda row: (int(row[1]), row[0] == "EDGE"))


_WAYS = {
    "manhattan3500": _manhattan,
    "city10000": _city,
    "victoria_park": _victoria,
    "citytrees10000": _city_trees,
    "killian": _killian,
}


@dataclass
class Answer:
    """length: what Content-Length says, where it is not that of the body; None leaves it out.

    released: waited for before the answer, or, with `head`, after that number of bytes of the body.
    """

    body: bytes = b""
    status: int = 200
    length: int | None = -1
    location: str = ""
    released: threading.Event | None = None
    head: int = 0
    garbage: bool = False


@dataclass
class Site:
    """A server of raw files: what it answers by path, and the paths asked for; `visited` is set by the first."""

    base: str
    answers: dict[str, Answer] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    visited: threading.Event = field(default_factory=threading.Event)

    def holds(self, repository: str, commit: str, path: str, answer: Answer) -> None:
        self.answers[f"/{repository}/{commit}/{path}"] = answer


@contextmanager
def raw_files() -> Iterator[Site]:
    """A server on loopback; on leaving, whatever still waits is released."""
    site = Site("")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            site.asked.append(self.path)
            site.visited.set()
            answer = site.answers.get(self.path, Answer(b"404: Not Found", 404))
            try:
                _send(self, answer)
            except (BrokenPipeError, ConnectionResetError):  # the client gave up, as some tests want it to
                self.close_connection = True

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    site.base = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield site
    finally:
        for answer in site.answers.values():
            if answer.released:
                answer.released.set()
        server.shutdown()
        thread.join(10)
        server.server_close()


def _send(handler: BaseHTTPRequestHandler, answer: Answer) -> None:
    if answer.released and not answer.head:
        answer.released.wait(30)
    if answer.garbage:
        handler.wfile.write(b"this is not http\r\n\r\n")
        return
    handler.send_response(answer.status)
    if answer.length is not None:
        handler.send_header("Content-Length", str(len(answer.body) if answer.length < 0 else answer.length))
    if answer.location:
        handler.send_header("Location", answer.location)
    handler.end_headers()
    if answer.released and answer.head:
        handler.wfile.write(answer.body[: answer.head])
        answer.released.wait(30)
    handler.wfile.write(answer.body[answer.head :])
