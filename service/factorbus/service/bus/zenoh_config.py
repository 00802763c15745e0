"""The Zenoh configuration of a service: paths and values, and why."""

from typing import Any

from factorbus.service.config import Config

# How Zenoh's threads are laid out in this process.  Its own way is two that receive, and one each that sends, accepts
# connections and does all else; what an answer or a delta then costs is to wake them.  When the two do it all, a
# callback's answer and delta leave on its own thread, as soon as it returns (measured with a step in between: 50 to 100
# µs of 700 to 850).  And what comes in is not first seen by the thread that has accepted the connection, nor does every
# query, and its end, wake one that watches how long queries take (measured: 60 of 550 µs; a third thread to wake costs
# 15 of them again).  Two are enough, as one at most has an InsertBatch (see `host.py`).  An operator who sets it
# otherwise is obeyed.
RUNTIME_VARIABLE = "ZENOH_RUNTIME"
RUNTIME = "(rx: (worker_threads: 2), tx: (handover: rx), acc: (handover: rx), net: (handover: rx))"


def zenoh_settings(config: Config) -> dict[str, Any]:
    """What a service sets in its Zenoh configuration."""
    settings: dict[str, Any] = {
        "mode": config.mode,
        "listen/endpoints": list(config.listen) if config.mode != "client" else [],
        "connect/endpoints": list(config.connect),
        # Only endpoints that somebody wrote down.
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # On by default, and drops a large message silently when its receiver is descheduled for 100 ms (zenoh #2628).
        "transport/shared_memory/enabled": False,
        # A frozen peer is noticed after 3 s, not 10.
        "transport/link/tx/lease": 3000,
        "transport/unicast/max_sessions": config.limits.sessions,
        # Connections that say nothing: by default a hundred of them keep everybody else out for ten seconds.  Measured,
        # with 150 of them: the next client got in after 21 s, and now at once.
        "transport/unicast/accept_pending": 1000,
        "transport/unicast/accept_timeout": 3000,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
        # Zenoh drops what is larger without a word; up to here the service itself can say too_large.
        "transport/link/rx/max_message_size": max(4 * config.limits.message_bytes, 16 << 20),
        # What one client may have under way before its deltas are dropped (it asks for the estimate then): 1 MiB.
        "transport/link/tx/queue/size/data": 16,
        "transport/link/tx/queue/size/data_low": 16,
        # How long one stuck client may hold up a publication to all, in microseconds; once per publication.
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 200,
        "transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 5000,
        # A client that does not take its answers for so long is disconnected; it reconnects by itself.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1_000_000,
        # Read-only; the service finds its own port there, and `factorbus doctor` what is connected.
        "adminspace/enabled": True,
    }
    if config.mode != "client":
        # Without something to connect to there is nobody to wait for; with it, start-up does not hang on it.
        settings |= {"scouting/delay": 0, "connect/timeout_ms": -1, "connect/exit_on_failure": False}
    return settings


def upstream_settings(endpoint: str) -> dict[str, Any]:
    """What a replica sets in the configuration of its session with its upstream."""
    return {
        "mode": "client",
        "connect/endpoints": [endpoint],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "transport/link/tx/lease": 3000,
        "connect/retry": {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5},
    }
