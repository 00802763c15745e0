"""The worker process, and the only file of the workers that touches Zenoh.

Zenoh's threads only queue what comes in; the slots' threads do the jobs and answer.  Zenoh itself reconnects when the
service restarts, and declares the queryable and the token again.
"""

import json
import logging
import queue
import secrets
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh
from zenoh.handlers import Callback

from factorbus.proto import codec, keys, redact
from factorbus.proto.messages import JobDone
from factorbus.proto.problems import BadConfigurationFile, Busy, Internal, Problem, ShuttingDown
from factorbus.proto.zenoh_file import check_zenoh_file
from factorbus.solver.errors import SolverError
from factorbus.workers import jobs
from factorbus.workers.config import BadConfig, WorkerConfig, checked_worker_config
from factorbus.workers.heap import keep_freed_memory

log = logging.getLogger(__name__)

_FIRST_PAUSE_S, _LONGEST_PAUSE_S = 0.1, 1.0
# A service sends no more than there are slots, but several services may send.
_WAITING_PER_SLOT = 16
# Python does not see a signal that comes right before a wait until that ends.
_LOOK_S = 0.5


def work(config: WorkerConfig, on_ready: Callable[[str], None], stop: threading.Event) -> None:
    """Take jobs until `stop` is set, then finish those begun and return.  Waits for the bus as long as it takes.

    `on_ready` gets the worker's name once it can be found.  Raises BadConfig, BadName.
    """
    checked_worker_config(config)
    settings = _settings(config)  # a bad file is said before the kernels are compiled
    keep_freed_memory()
    from factorbus.solver import compile_seconds, warm, why_stock_numba

    if why := why_stock_numba():
        log.warning("kernels are compiled by Numba as it is, which takes longer, and take longer themselves: %s", why)
    if config.warm:
        from factorbus.idp import warm_idp

        seconds = sum(make(lambda name: _announce(name, compile_seconds())) for make in (warm, warm_idp))
        log.info("kernels ready after %.1f s", seconds)
    sys.setswitchinterval(0.0005)
    session = _open(config, settings, stop)
    if session is None:
        return
    try:
        _take_jobs(session, config.name or f"w{secrets.token_hex(4)}", config.slots, on_ready, stop)
    finally:
        session.close()


def _announce(kernels: str, compiled_s: float) -> None:
    """On a cold start, say what is being compiled; loading what was compiled before takes no time worth a line."""
    if compiled_s:
        log.info("compiling kernels: %s", kernels)


def _open(config: WorkerConfig, settings: zenoh.Config, stop: threading.Event) -> zenoh.Session | None:
    """A session, or None when `stop` was set before there was one."""
    pause = _FIRST_PAUSE_S
    while not stop.is_set():
        try:
            return zenoh.open(settings)
        except zenoh.ZError as error:
            log.info("nothing at %s yet (%s)", redact.endpoint(", ".join(config.connect)), redact.reason(error))
        stop.wait(pause)
        pause = min(2 * pause, _LONGEST_PAUSE_S)
    return None


def _settings(config: WorkerConfig) -> zenoh.Config:
    paths: dict[str, Any] = {
        "mode": "client",
        "connect/endpoints": list(config.connect),
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # On by default, and drops a large message silently when its receiver is descheduled for 100 ms (zenoh #2628).
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 3000,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 1.5},
    }
    if config.zenoh:
        check_zenoh_file(config.zenoh)
    try:
        settings = zenoh.Config.from_file(config.zenoh) if config.zenoh else zenoh.Config()
    except zenoh.ZError as error:
        # Not from `error`: a traceback would show the line of the file, and what secrets are on it.
        raise BadConfigurationFile(config.zenoh, redact.reason(error)) from None
    try:
        for path, value in paths.items():
            settings.insert_json5(path, json.dumps(value))
    except zenoh.ZError as error:
        where = config.zenoh or "built in"
        raise BadConfig(f"Zenoh does not take this configuration ({where}): {redact.reason(error)}") from None
    return settings


def _take_jobs(
    session: zenoh.Session, name: str, slots: int, on_ready: Callable[[str], None], stop: threading.Event
) -> None:
    waiting: queue.Queue[zenoh.Query | None] = queue.Queue()

    def take(query: zenoh.Query) -> None:
        waiting.put(query)

    threads = [
        threading.Thread(target=_slot, args=(waiting, slots, stop), name=f"slot {n}", daemon=True) for n in range(slots)
    ]
    for thread in threads:
        thread.start()
    queryable = session.declare_queryable(keys.job_key(name), Callback(take, indirect=False))
    # Last of all: alive means that jobs are taken.
    token = session.liveliness().declare_token(keys.worker_token(name, slots))
    log.info("worker %s takes %d jobs at a time", name, slots)
    on_ready(name)
    while not stop.wait(_LOOK_S):
        pass
    for _ in threads:
        waiting.put(None)  # behind everything queued, which is refused from now on
    for thread in threads:
        thread.join()
    token.undeclare()
    queryable.undeclare()


def _slot(waiting: "queue.Queue[zenoh.Query | None]", slots: int, stop: threading.Event) -> None:
    while (query := waiting.get()) is not None:
        with query:
            try:
                if stop.is_set():
                    _refuse(query, ShuttingDown())
                elif waiting.qsize() > slots * _WAITING_PER_SLOT:
                    _refuse(query, Busy(waiting.qsize(), 1.0))
                else:
                    _do(query)
            except zenoh.ZError as error:
                log.warning("not answered: %s", error)
        del query  # a query kept alive keeps its asker waiting


def _do(query: zenoh.Query) -> None:
    started = time.perf_counter()
    try:
        job = codec.decode_job(query.payload.to_bytes() if query.payload is not None else b"")
        result = jobs.run_job(job.kind, job.payload)
    except (Problem, SolverError) as problem:
        _refuse(query, problem)
    except Exception:
        reference = secrets.token_hex(4)
        log.exception("fault %s", reference)
        _refuse(query, Internal(reference))
    else:
        seconds = time.perf_counter() - started
        log.log(logging.INFO if seconds > 0.1 else logging.DEBUG, "job %s (%s): %.3f s", job.job, job.kind, seconds)
        query.reply(query.key_expr, codec.encode_job_done(JobDone(job.job, job.kind, result, seconds)))


def _refuse(query: zenoh.Query, problem: Any) -> None:
    query.reply_err(codec.encode_problem(problem))
