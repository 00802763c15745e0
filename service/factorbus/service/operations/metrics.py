"""The health report as Prometheus metrics, and the two questions of an orchestrator, over HTTP.

    /metrics   all that admin/stats says, in the text format of Prometheus
    /live      200 while no thread is stuck, else 503, with the names of those that are
    /ready     200 while it is alive and takes inserts, else 503

All who reach the port can read: what it says has names of maps and workers in it, and nothing of what is in maps.
"""

import logging
import threading
from collections.abc import Iterable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from typing import Any, NamedTuple

from factorbus.proto.ports import check_free, listening_problem
from factorbus.service.config import BadConfig
from factorbus.service.operations.health_report import HealthReport

log = logging.getLogger(__name__)

_TEXT = "text/plain; charset=utf-8"


class Metrics:
    """The port, open until it is closed; without a server nothing is."""

    def __init__(self, server: ThreadingHTTPServer | None = None) -> None:
        self._server = server
        if server is not None:
            threading.Thread(target=server.serve_forever, name="metrics", daemon=True).start()

    @property
    def port(self) -> int:
        """Where it listens; 0: nowhere."""
        return self._server.server_address[1] if self._server is not None else 0

    def close(self) -> None:
        """Listen no more."""
        if self._server is not None:
            self._server.shutdown()
            self._server.server_close()


def check_metrics(where: str) -> None:
    """Whether metrics could be served at `where`, or need not be.  Raises BadConfig, PortTaken, CannotListen."""
    if where:
        if find_spec("prometheus_client") is None:
            raise BadConfig("metrics need prometheus-client, of the extra `service`: factorbus doctor")
        host, port = _address(where)
        check_free(_named(where), host, port)


def open_metrics(where: str, health_report: HealthReport) -> Metrics:
    """Serve what `health_report` knows at `where` (HOST:PORT); nowhere if that is empty.

    Raises PortTaken, CannotListen.
    """
    if not where:
        return Metrics()
    host, port = _address(where)
    try:
        server = _Server((host, port), _handler(health_report))
    except OSError as error:
        raise listening_problem(_named(where), error) from None
    opened = Metrics(server)
    log.info("metrics at http://%s:%d/metrics", host, opened.port, extra={"port": opened.port})
    return opened


def _address(where: str) -> tuple[str, int]:
    host, _, port = where.rpartition(":")
    return host.strip("[]"), int(port)


def _named(where: str) -> str:
    return f"{where}, for metrics,"


class Family(NamedTuple):
    """One metric: its type, what it means, and its samples by labels."""

    name: str
    kind: str  # gauge, counter, histogram
    help: str
    labels: tuple[str, ...]
    samples: list[tuple[tuple[str, ...], Any]]


def families(health: Mapping[str, Any]) -> Iterator[Family]:
    """The metrics that `health` comes to.  A counter's name has no _total yet."""
    yield _one(
        "info", "gauge", "1, with who and which version", 1.0, service=health["service"], version=health["version"]
    )
    yield _one("uptime_seconds", "gauge", "Since the service began", health["uptime_s"])
    yield _one("alive", "gauge", "1 while no thread is stuck", health["alive"])
    yield _one("ready", "gauge", "1 while it is alive and takes inserts", health["ready"])
    yield _one("memory_bytes", "gauge", "Resident memory of the process", health["memory"]["resident_bytes"])
    yield _one("memory_limit_bytes", "gauge", "From here on inserts are refused", health["memory"]["limit_bytes"])
    yield _by(
        "silent_seconds", "gauge", "How long a thread has not come to its next work", "thread", health["silent_s"]
    )
    cores = health.get("cores", {"used": 1, "pieces": 0})
    yield _one("cores", "gauge", "Cores that one elimination may be at work on", cores["used"])
    yield _one("pieces", "counter", "Pieces of eliminations made on other cores than the map's own", cores["pieces"])
    yield from _of_workers(health.get("workers", ()))
    yield from _of_maps(health["maps"])
    yield from of_interests(health.get("interests", ()))
    yield _one("maps_unopened", "gauge", "Maps on disk that do not open", len(health.get("unopened", ())))
    yield from _extra("disk", "", {"": health.get("disk", {})})


def _of_workers(rows: Iterable[Mapping[str, Any]]) -> Iterator[Family]:
    rows = list(rows)
    yield _one("workers", "gauge", "Workers that are here", len(rows))
    for name, what in (
        ("slots", "Jobs it takes at a time"),
        ("in_flight", "Jobs it has"),
        ("latency_ms", "The way there, ms"),
    ):
        samples = {row["name"]: row[name] for row in rows if name in row}
        yield _by(f"worker_{name}", "gauge", what, "worker", samples)
    wrong = {row["name"]: row["wrong"] for row in rows if "wrong" in row}
    yield _by("worker_wrong_answers", "counter", "Answers of it that could not be right", "worker", wrong)
    distrusted = {row["name"]: row["distrusted"] for row in rows if "distrusted" in row}
    yield _by("worker_distrusted", "gauge", "1 while it gets no jobs because of that", "worker", distrusted)


def of_interests(rows: Iterable[Mapping[str, Any]]) -> Iterator[Family]:
    """Those of the interests, by map."""
    rows = list(rows)
    maps = sorted({row["map"] for row in rows})
    counts = {each: sum(row["map"] == each for row in rows) for each in maps}
    yield _by("map_interests", "gauge", "Interests that clients follow", "map", counts)
    for name, what in (
        ("bytes", "Bytes that the channels of present interests have carried"),
        ("waiting", "Variables that wait for what their channel may carry"),
    ):
        totals = {each: sum(row[name] for row in rows if row["map"] == each) for each in maps}
        yield _by(f"map_interest_{name}", "gauge", what, "map", totals)


_GAUGES = {
    "variables": "Variables in the map",
    "factors": "Factors in the map",
    "revision": "Its revision",
    "chi2": "Sum of squared errors",
    "converged": "1 while the last step had converged",
    "converging": "1 while the map, left alone, takes further steps by itself to its optimum",
    "clients": "Client names whose sequence is known",
    "waiting": "Inserts that wait for a step",
    "parked": "Inserts that wait for the one before them",
    "in_solver": "Inserts in the step that is running",
}


def _of_maps(maps: Iterable[Mapping[str, Any]]) -> Iterator[Family]:
    rows = {row["name"]: row for row in maps}
    yield _one("maps", "gauge", "Maps that are kept", len(rows))
    for name, what in _GAUGES.items():
        yield _by(f"map_{name}", "gauge", what, "map", {m: row[name] for m, row in rows.items()})
    yield _by("steps", "counter", "Steps of the solver", "map", {m: row["steps"] for m, row in rows.items()})
    cpu = {m: row["solver_cpu_s"] for m, row in rows.items()}
    yield _by("solver_cpu_seconds", "counter", "Processor time of applying inserts", "map", cpu)
    for name, key, what, label in (
        ("strategy", "strategies", "Steps by how they were made", "strategy"),
        ("inserts", "inserts", "Inserts by what became of them", "outcome"),
        ("refusals", "refusals", "Refused inserts by problem", "code"),
        ("bytes", "bytes", "Bytes of inserts received, of answers to them, of deltas published", "what"),
    ):
        samples = [((m, str(each)), count) for m, row in rows.items() for each, count in row[key].items()]
        yield Family(name, "counter", what, ("map", label), samples)
    for name, key, what in (
        ("step_seconds", "step_s", "Time of a step in the solver"),
        ("insert_seconds", "insert_s", "Time from the arrival of an insert to its step's end"),
    ):
        yield Family(name, "histogram", what, ("map",), [((m,), row[key]) for m, row in rows.items()])
    states = [((m, s), n) for m, row in rows.items() for s, n in row.get("closure_states", {}).items()]
    yield Family("map_closures", "gauge", "Loop closures of maps that test theirs", ("map", "state"), states)
    kept = {m: row["kept"] for m, row in rows.items() if "kept" in row}
    yield from _extra("kept", "map", kept)
    yield from _extra("journal", "map", {m: row.get("journal", {}) for m, row in rows.items()})
    yield from _of_budgets({m: row["budget"] for m, row in rows.items() if "budget" in row})


_BUDGET_GAUGES = {
    "budget_ms": "What a step may take",
    "step_ms": "What the last step took, to which that applies",
    "deferred_relinearizations": "Variables that later steps are to relinearize",
    "unsolved": "How far chi2 may be above its optimum, as far as the last step says",
    "complete": "1 where the last step left nothing for later ones",
    "units_per_ms": "Units of work that are given for a millisecond",
}


def _of_budgets(rows: Mapping[str, Mapping[str, Any]]) -> Iterator[Family]:
    """Those of maps whose steps have a budget, if there are any."""
    for name, what in _BUDGET_GAUGES.items() if rows else ():
        yield _by(
            f"map_{name}", "gauge", what, "map", {m: row[name] for m, row in rows.items() if row[name] is not None}
        )


def _extra(chapter: str, label: str, by: Mapping[str, Mapping[str, Any]]) -> Iterator[Family]:
    """Numbers that another part of the service adds under a name of its own: each a gauge `<chapter>_<number>`."""
    names = sorted({n for each in by.values() for n, value in each.items() if isinstance(value, int | float)})
    kind = f"{label}_{chapter}" if label else chapter
    for name in names:
        samples = [((who,) if label else (), row[name]) for who, row in by.items() if name in row]
        yield Family(f"{kind}_{name}", "gauge", f"{chapter}: {name}", (label,) if label else (), samples)


def _one(name: str, kind: str, what: str, value: Any, **labels: str) -> Family:
    return Family(name, kind, what, tuple(labels), [(tuple(labels.values()), value)])


def _by(name: str, kind: str, what: str, label: str, values: Mapping[str, Any]) -> Family:
    return Family(name, kind, what, (label,), [((who,), value) for who, value in values.items()])


# ---- HTTP -----------------------------------------------------------------------------------------------------------


class _Collector:
    """What Prometheus's library asks at every scrape."""

    def __init__(self, health_report: HealthReport) -> None:
        self._health_report = health_report

    def collect(self) -> Iterator[Any]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

        kinds = {"gauge": GaugeMetricFamily, "counter": CounterMetricFamily, "histogram": HistogramMetricFamily}
        for family in families(self._health_report.read()):
            made = kinds[family.kind](f"factorbus_{family.name}", family.help, labels=family.labels)
            for labels, value in family.samples:
                if family.kind == "histogram":
                    made.add_metric(labels, _buckets(value), value["sum_s"])
                else:
                    made.add_metric(labels, float(value))
            yield made


def _buckets(histogram: Mapping[str, Any]) -> list[tuple[str, float]]:
    """Prometheus counts what is at most a bound, so counts add up."""
    buckets, total = [], 0
    for bound, count in zip([*map(str, histogram["bounds_s"]), "+Inf"], histogram["counts"], strict=True):
        total += count
        buckets.append((bound, float(total)))
    return buckets


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    _THREADS = 16

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._room = threading.BoundedSemaphore(self._THREADS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """A client that opens many connections and says nothing gets no more threads than there is room for."""
        if self._room.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._room.release()


def _handler(health_report: HealthReport) -> type[BaseHTTPRequestHandler]:
    from prometheus_client import CollectorRegistry
    from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

    registry = CollectorRegistry(auto_describe=False)
    registry.register(_Collector(health_report))  # type: ignore[arg-type]

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0

        def do_GET(self) -> None:
            match self.path.partition("?")[0]:
                case "/metrics":
                    self._say(200, CONTENT_TYPE_LATEST, generate_latest(registry))
                case "/live":
                    self._say(*_word([f"stuck: {', '.join(names)}"] if (names := health_report.health.stuck()) else []))
                case "/ready":
                    self._say(*_word(health_report.health.missing()))
                case _:
                    self._say(404, _TEXT, b"there are /metrics, /live and /ready\n")

        def _say(self, code: int, kind: str, body: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            log.debug(format, *args)

    return Handler


def _word(missing: list[str]) -> tuple[int, str, bytes]:
    return (503, _TEXT, f"{'; '.join(missing)}\n".encode()) if missing else (200, _TEXT, b"ok\n")
