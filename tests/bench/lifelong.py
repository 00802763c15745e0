"""A robot that drives the same round for years, in a map that keeps some poses and tests its loop closures.

    factorbus bench lifelong [--steps N] [--lives N] [--false SHARE] [--seed S] [--json]

Over the bus, with a journal: a pose an insert, a metre each, round a square of 160 m. Poses close loops with what the
map still has there; of these closures a share is false, drawn anywhere.  The service is killed (SIGKILL) at the end of
each of its lives, in the middle of an insert, and started again.  Of each life:

    steps       driven so far
    variables, factors   of the map
    memory_mb   of the service at the end of the life
    step_ms     of an insert until its estimate is here: median, and 99th percentile
    error_m     root mean square of the positions, best laid upon the square
    false_in, right_out   closures that the map believes and should not, and the other way, of all so far
    refused     inserts that named a pose that the map had just taken out, and were sent again without it

At the end the journal is applied once more from its first insert on: every answer and every estimate has to have the
bits that it had.  The exit code is 1 where it has not, where an insert is gone after a restart, or where in the second
half of the lives the memory or the map is larger by more than a tenth than in the first.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from process_memory import resident
from processes import Process, processes

from factorbus.client import Draft, connect
from factorbus.client.map import Map
from factorbus.proto.problems import Refused

ROUND, WINDOW, NEAR = 160, 20, 4
ODOMETRY, SEEN = (0.02, 0.02, 0.005), (0.05, 0.05, 0.01)
NAME, PATIENCE_S, MOST_GROWTH = "town", 300.0, 1.1
_INDEX = (1 << 56) - 1


class Robot:
    """Drives on from where it is, whatever the map has left of its way."""

    def __init__(self, false_share: float, seed: int) -> None:
        self.chance, self.false_share = np.random.default_rng(seed), false_share
        self.pose = 0  # the newest that was answered
        self.false: set[tuple[int, int]] = set()
        self.took_s: list[float] = []
        self.refused = 0

    def step(self, town: Map) -> None:
        """The next pose."""
        n = self.pose + 1
        ahead = self.seen(n - 1, n, ODOMETRY)
        odometry, draft = (
            Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", ahead, sigmas=ODOMETRY) for _ in range(2)
        )
        if n % 2 == 0:
            for k, z in self.closures(town, n):
                draft.between_se2(f"x{k}", f"x{n}", z, sigmas=SEEN)
        began = time.perf_counter()
        try:
            town.insert(draft)
        except Refused as refused:
            if refused.code != "unknown_variable":
                raise
            self.refused += 1
            town.insert(odometry)
        self.took_s.append(time.perf_counter() - began)
        self.pose = n

    def send(self, town: Map) -> None:
        """The next pose by its odometry alone, without waiting for the answer."""
        n = self.pose = self.pose + 1
        town.send(
            Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", self.seen(n - 1, n, ODOMETRY), sigmas=ODOMETRY)
        )

    def closures(self, town: Map, n: int) -> list[tuple[int, np.ndarray]]:
        """Two at most, with poses that the map has, and that are not the newest."""
        there = np.sort(town.estimate.columns("se2")[0] & _INDEX)
        there = there[there < n - WINDOW]
        apart = (there - n + ROUND // 2) % ROUND - ROUND // 2
        found: list[tuple[int, np.ndarray]] = []
        for k in there[np.abs(apart) <= NEAR][:2].tolist():
            if self.chance.random() < self.false_share:
                k = int(self.chance.choice(there))
                self.false.add((k, n))
                found.append((k, self.chance.uniform((-20, -20, -np.pi), (20, 20, np.pi))))
            else:
                found.append((k, self.seen(k, n, SEEN)))
        return found

    def seen(self, one: int, other: int, sigmas: tuple[float, ...]) -> np.ndarray:
        """Place `other` of the round from place `one`, with noise."""
        (x, y, theta), (u, v, turned) = place(one), place(other)
        c, s = np.cos(theta), np.sin(theta)
        turn = (turned - theta + np.pi) % (2 * np.pi) - np.pi
        return np.array([c * (u - x) + s * (v - y), c * (v - y) - s * (u - x), turn]) + self.chance.normal(0, sigmas)


def place(n: int) -> tuple[float, float, float]:
    """x, y, θ of the n-th metre."""
    side, along = divmod(n % ROUND, ROUND // 4)
    corners = np.array([[0, 0], [40, 0], [40, 40], [0, 40]])
    theta = side * np.pi / 2
    x, y = corners[side] + along * np.array([np.cos(theta), np.sin(theta)])
    return float(x), float(y), float(theta)


def run(steps: int, lives: int, false_share: float, seed: int, folder: Path) -> dict[str, Any]:
    """Drive, and judge."""
    robot, rows, lost, journal = Robot(false_share, seed), list[dict[str, Any]](), 0, folder / "journal"
    with processes(folder) as start:
        service = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(journal))
        (endpoint,) = service.ready()
        with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus:
            bus.create(NAME, keep={"per_area": 2.5, "window": WINDOW}, closures="test")
            with bus.map(NAME) as town:
                town.insert(Draft().se2("x0", place(0), fixed=True))
                for life in range(1, lives + 1):
                    robot.took_s.clear()
                    while robot.pose < steps * life // lives:
                        robot.step(town)
                    rows.append(_row(town, robot, service))
                    # The next pose is on its way when the service is killed; the client sends it again by itself.
                    robot.send(town)
                    service.end()
                    service = start("-m", "factorbus.service", "--listen", endpoint, "--journal", str(journal))
                    service.ready()
                    town.flush()
                    lost += robot.pose - int((town.ask_estimate().variables[0].keys & _INDEX).max())
        service.end()
    told = _verified(journal)
    growth = {what: _growth(rows, what) for what in ("variables", "memory_mb")}
    return {"rows": rows, "seed": seed, "lost": lost, "growth": growth, "verified": told}


def _row(town: Map, robot: Robot, service: Process) -> dict[str, Any]:
    found, closures = town.stats(), town.suspects(every=True)
    keys, values = town.estimate.columns("se2")
    p50, p99 = np.percentile(robot.took_s, (50, 99)) * 1e3
    pairs = [(int(a) & _INDEX, int(b) & _INDEX) for a, b in closures.keys.tolist()]
    is_in = [state in ("accepted", "restored") for state in closures.states]
    return {
        "steps": robot.pose,
        "variables": found["variables"],
        "factors": found["factors"],
        "memory_mb": round(resident(service.pid) / 1e6, 1),
        "step_ms": [round(float(p50), 2), round(float(p99), 2)],
        "error_m": round(_error(keys & _INDEX, values), 3),
        "closures": len(pairs),
        "false_in": sum(i for pair, i in zip(pairs, is_in, strict=True) if pair in robot.false),
        "right_out": sum(not i for pair, i in zip(pairs, is_in, strict=True) if pair not in robot.false),
        "refused": robot.refused,
    }


def _error(indices: np.ndarray, values: np.ndarray) -> float:
    """Of positions best laid upon the square (Umeyama), metres."""
    truth = np.array([place(int(n))[:2] for n in indices])
    here = values[:, :2] - values[:, :2].mean(axis=0)
    there = truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(there.T @ here)
    turn = U @ np.diag([1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt(((there - here @ turn.T) ** 2).sum(axis=1).mean()))


def _growth(rows: list[dict[str, Any]], what: str) -> float:
    """The most of the second half for the most of the first, which begins with the second life."""
    half = (len(rows) + 1) // 2
    return round(max(row[what] for row in rows[half:]) / max(row[what] for row in rows[1:half]), 3)


def _verified(journal: Path) -> dict[str, Any]:
    """What `factorbus journal verify` says of it."""
    line = [sys.executable, "-P", "-m", "factorbus.cli", "journal", "verify", NAME, "--journal", str(journal), "--json"]
    told = subprocess.run(line, capture_output=True, text=True, check=False)
    if not told.stdout:
        raise RuntimeError(f"factorbus journal verify ended with {told.returncode}: {told.stderr}")
    (row,) = json.loads(told.stdout)["maps"]
    return {what: row.get(what) for what in ("records", "revision", "differs_from", "code")}


def main() -> int:
    parser = argparse.ArgumentParser(prog="factorbus bench lifelong", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--lives", type=int, default=20, help="of the service")
    parser.add_argument("--false", dest="false_share", type=float, default=0.2, help="share of the closures")
    parser.add_argument("--seed", type=int, help="without, another one each time")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    told = parser.parse_args()
    seed = int(np.random.default_rng().integers(2**31)) if told.seed is None else told.seed
    with tempfile.TemporaryDirectory() as folder:
        result = run(told.steps, told.lives, told.false_share, seed, Path(folder))
    if told.json:
        print(json.dumps(result))
    else:
        for row in result["rows"]:
            print("  ".join(f"{key} {value}" for key, value in row.items()))
        print(f"seed {seed}; lost {result['lost']}; growth {result['growth']}; journal {result['verified']}")
    is_same = result["verified"]["differs_from"] is None and result["verified"]["code"] is None
    return 0 if is_same and not result["lost"] and max(result["growth"].values()) <= MOST_GROWTH else 1


if __name__ == "__main__":
    sys.exit(main())
