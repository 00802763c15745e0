"""What the doctor looks at in services on the bus: one finding for each of them."""

from collections.abc import Iterator, Mapping
from typing import Any

from factorbus.cli.doctor.checks import Finding
from factorbus.proto.problems import Problem
from factorbus.proto.version import __version__
from factorbus.wording import counted

_WAIT_S = 5.0


def services(endpoint: str, zenoh: str) -> list[Finding]:
    """How the services at `endpoint` are; a failure where none answers."""
    from factorbus.cli.process.bus import open_bus

    try:
        with open_bus(endpoint, "doctor", zenoh, _WAIT_S) as bus:
            return [finding(stats) for stats in bus.stats()]
    except Problem as problem:
        mend = "is it running (systemctl status factorbus)? with access control, only an operator may ask: give --zenoh"
        return [Finding("services", "fail", problem.message, mend)]


def finding(stats: Mapping[str, Any]) -> Finding:
    """The worst that `stats` tells of its service."""
    name, maps = f"service {stats['service']}", stats["maps"]
    told = ", ".join(f"{row['name']} ({counted(row['variables'], 'variable')})" for row in maps) or "no maps"
    for state, seen, mend in _troubles(stats):
        return Finding(name, state, f"{seen}; {told}", mend)
    return Finding(name, "ok", f"alive, {told}, {counted(len(stats.get('workers', ())), 'worker')}")


def _troubles(stats: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """(state, seen, mend), the worst first."""
    if stats["stuck"]:
        seen = f"stuck: {', '.join(stats['stuck'])}"
        yield "fail", seen, "look into its log and restart it; WatchdogSec= in its systemd unit does so by itself"
    for row in stats.get("unopened", ()):
        mend = f"restore its folder from a copy and restart, or `factorbus drop {row['name']} --damaged` gives it up"
        yield "fail", f"map {row['name']} does not open ({row['state']}): {row['problem']}", mend
    resident, limit = (stats["memory"][name] for name in ("resident_bytes", "limit_bytes"))
    if resident > 0.9 * limit:
        state = "fail" if resident > limit else "warn"
        mend = "drop or move a map, or give it more (limits.memory_bytes): beyond the limit inserts are refused"
        yield state, f"{resident >> 20} MiB of memory, {limit >> 20} MiB allowed", mend
    for row in stats["maps"]:
        if why := row.get("journal", {}).get("problem"):
            yield "fail", why, "make room or make it writable: the map goes on by itself"
    for row in stats["maps"]:
        if follows := row.get("upstream"):
            yield from _following(row["name"], follows)
    if not stats["ready"]:
        yield "warn", "alive, but not ready", "it is starting or stopping: look again"
    if (version := stats["version"]) != __version__:
        yield "warn", f"version {version}, here it is {__version__}", "the same wire; update when it suits"
    for row in stats["maps"]:
        inserts = row["inserts"]
        if inserts["busy"] > 0.1 * max(inserts["accepted"], 10):
            mend = "clients send faster than it solves: insert less often, or spread maps over more services"
            yield "warn", f"map {row['name']} answered {inserts['busy']} of its inserts with busy", mend


def _following(name: str, row: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """What is wrong between a replica's map and its upstream."""
    behind = f"upstream {row['endpoint']} lacks {counted(row['behind'], 'insert')} of map {name}"
    if row["code"]:
        yield (
            "fail",
            f"{behind}: {row['problem']}",
            f"`factorbus explain {row['code']}` says more; the map here goes on",
        )
    elif not row["connected"]:
        seen = f"{behind}, out of reach for {row['since_s']:.0f} s"
        yield "warn", seen, "the map here goes on and sends them when the link is back; is the service there running?"
    elif not row["same_bits"]:
        mend = "run the same version of factorbus, on the same kind of processor, at both ends"
        yield "warn", f"map {name} has other bits than upstream {row['endpoint']}", mend
