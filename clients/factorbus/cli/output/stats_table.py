"""The numbers that `factorbus top` shows: what a service counts, and by how much since the last reading."""

import time
from typing import Any

from factorbus.client import Bus, Map, Problem, Unavailable

_ANSWER_S = 3.0


class Indicators:
    """Reads a service's counters; rates are those between two readings."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._joined: dict[str, Map] = {}
        self._before: dict[tuple[str, int], tuple[float, dict[str, Any]]] = {}

    def read(self) -> dict[str, Any]:
        """For JSON: service, version, answer_ms, maps, unopened, clients, workers, interests.

        `unavailable` says why there is nothing.
        """
        seen: dict[str, Any] = {"unavailable": "", "service": "", "version": "", "answer_ms": 0.0}
        seen |= {"maps": [], "unopened": [], "clients": [], "workers": [], "interests": []}
        try:
            start = time.perf_counter()
            rows = self._bus.maps(_ANSWER_S)
            seen["answer_ms"] = (time.perf_counter() - start) * 1e3
            seen["unopened"] = [f"{row.name} does not open ({row.state})" for row in rows if row.problem]
            for row in (row for row in rows if not row.problem):
                self._read_map(row.name, seen)
        except Unavailable as nobody:
            seen["unavailable"] = nobody.message
        return seen

    def _read_map(self, name: str, seen: dict[str, Any]) -> None:
        try:
            if name not in self._joined:
                self._joined[name] = self._bus.map(name, mirror=False, create=False)
            stats = self._joined[name].stats(_ANSWER_S)
        except Unavailable:
            raise
        except Problem:  # dropped since the list was made
            self._joined.pop(name, None)
            return
        present = self._joined[name].clients(_ANSWER_S)
        now = time.perf_counter()
        at, before = self._before.get((name, stats["epoch"]), (now, stats))
        self._before[name, stats["epoch"]] = now, stats
        seconds = max(now - at, 1e-9)
        steps = stats["steps"] - before["steps"]
        seen["service"], seen["version"], seen["workers"] = stats["service"], stats["version"], stats["workers"]
        taken = stats["inserts"]["accepted"] - before["inserts"]["accepted"]
        plain = ("name", "mode", "variables", "factors", "revision", "chi2", "waiting", "parked", "epoch")
        seen["maps"].append(
            {key: stats[key] for key in plain}
            | {
                "steps_per_s": steps / seconds,
                "inserts_per_s": taken / seconds,
                "step_ms": (stats["solver_ms"] - before["solver_ms"]) / steps if steps else None,
                "converged": stats["converged"],
                "converging": stats["converging"],
                "further_steps": stats["further_steps"],
                "gave_up": stats["gave_up"],
                "refused": stats["inserts"]["refused"],
                "busy": stats["inserts"]["busy"],
                **({"closure_states": stats["closure_states"]} if "closure_states" in stats else {}),  # where tested
                **({"budget": stats["budget"]} if "budget" in stats else {}),  # where steps have one
                **({"upstream": stats["upstream"]} if "upstream" in stats else {}),  # of a replica
            }
        )
        carried = {row["channel"]: row["bytes"] for row in before.get("interests", ())}
        for row in stats.get("interests", ()):
            fresh = row["bytes"] - carried.get(row["channel"], 0)
            seen["interests"].append(row | {"map": name, "carried_per_s": max(fresh, 0) / seconds if at < now else 0.0})
        for client, following in sorted(stats["clients"].items()):
            fresh = following - before["clients"].get(client, 1)  # the number that it sends next begins at 1
            # Tokens are optional: who inserts without one is there too.
            here = client in present or fresh > 0
            seen["clients"].append(
                {"name": client, "map": name, "here": here, "inserts": following - 1, "inserts_per_s": fresh / seconds}
            )
