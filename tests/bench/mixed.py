"""Everything at once for a while: six clients that insert, ask, change, fork and drop; memory and files stay.

    python tests/bench/mixed.py [--minutes 20] [--clients 6] [--round-s 20] [--seed N] [--json]

Rounds: in each every client has a map of its own, into which the client after it inserts too, and does what it draws:
inserts, questions of every sort, changes, forks that are used and dropped, its map dropped and made anew.  At the end
of a round all maps are dropped, and what the service has then is read: resident memory, open files, files of its
journals.  In the last round it is killed instead (SIGKILL) and started again, and every map is to be there to the bit.

Goal: nothing answered `internal` or not at all; open files and files on disk the same after every round; memory that
does not grow: the most of the last third is at most 1.05 times the most of the third before it.
"""

import argparse
import logging
import random
import signal
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.results import print_figures
from process_memory import resident
from processes import Process, processes

from factorbus.client import Bus, Changes, Draft, connect
from factorbus.client.map import Map
from factorbus.proto.problems import Problem

GOAL_GROWTH = 1.05
POSES = 150  # a map that has more is dropped and made anew
SIGMAS = (0.1, 0.1, 0.05)
_PATIENCE_S = 60.0
# What may be answered where a map is dropped and changed meanwhile: none of it is a fault.
EXPECTED = {"unknown_map", "wrong_epoch", "unknown_variable", "unknown_factor", "underconstrained"}


class Client(threading.Thread):
    """One of the six: a session of its own, a map of its own, and the map of the one before it."""

    def __init__(self, endpoint: str, number: int, clients: int, seed: int) -> None:
        super().__init__(daemon=True)
        self.name_here, self._beside = f"mixed-{number}", f"mixed-{(number - 1) % clients}"
        self._letter, self._endpoint = "abcdefghijkl"[number], endpoint
        self._chance, self._end = random.Random(f"{seed} {number}"), threading.Event()
        self.done, self.codes, self.faults = Counter[str](), Counter[str](), list[str]()

    def stop(self) -> None:
        """After what is under way."""
        self._end.set()

    def run(self) -> None:
        """Until told to stop."""
        with connect(self._endpoint, client=f"client{self._letter}", timeout_s=_PATIENCE_S) as bus:
            while not self._end.is_set():
                try:
                    self._live(bus)
                except Problem as problem:
                    self._count(problem)
                except Exception as fault:
                    self.faults.append(f"{type(fault).__name__}: {fault}")
                    return

    def _live(self, bus: Bus) -> None:
        """One life of the map, from its first pose until it is large or somebody told us to stop."""
        with bus.map(self.name_here) as own:
            first = own.stats()["variables"]
            self._begin(own, first)
            for n in range(first + 1, first + POSES):
                if self._end.is_set():
                    return
                self._insert(own, n)
                kind = self._chance.choices(list(_OTHERS), [weight for weight, _ in _OTHERS.values()])[0]
                try:
                    _OTHERS[kind][1](self, bus, own, n)
                    self.done[kind] += 1
                except Problem as problem:
                    self._count(problem)
        bus.drop(self.name_here)
        self.done["drop"] += 1

    def _begin(self, own: Map, n: int) -> None:
        own.insert(Draft().se2(self._key(n), (0, 0, 0), fixed=True).point2(f"l{n}", (1, 1)).prior_point2(
            f"l{n}", (1, 1), sigmas=(1, 1)))  # fmt: skip
        self._landmark = f"l{n}"

    def _insert(self, own: Map, n: int) -> None:
        draft = Draft().se2(self._key(n))
        draft.between_se2(self._key(n - 1), self._key(n), (1, 0, self._chance.gauss(0.1, 0.02)), sigmas=SIGMAS)
        if n % 8 == 0:
            draft.landmark_se2(self._key(n), self._landmark, (1, 2), sigmas=(0.5, 0.5), loss=("huber", 1.0))
        if n % 21 == 0:
            draft.between_se2(self._key(n - 5), self._key(n), (4, 1, 0.5), sigmas=SIGMAS, loss="dcs")
        own.insert(draft, settle=n % 40 == 0)
        self.done["insert"] += 1

    def _key(self, n: int) -> str:
        return f"{self._letter}{n}"

    def _count(self, problem: Problem) -> None:
        self.codes[problem.code] += 1
        if problem.code not in EXPECTED:
            self.faults.append(f"{problem.code}: {problem}")

    # ---- what it does besides -------------------------------------------------------------------------------------

    def _some(self, n: int) -> str:
        return self._key(self._chance.randrange(max(n - 20, 1), n + 1))

    def _ask(self, _: Bus, own: Map, n: int) -> None:
        key, uncertain = self._some(n), own.uncertainty
        draft = Draft().between_se2(key, self._key(n - 1), (1, 0, 0), sigmas=SIGMAS)
        questions: list[Callable[[], Any]] = [
            own.chi2, own.graph, own.stats, own.components, own.ask_estimate, own.export, uncertain.last,
            uncertain.covariance, lambda: uncertain.covariance([key]), lambda: uncertain.joint([key, self._landmark]),
            lambda: uncertain.relative([(key, self._landmark)]), lambda: uncertain.why(key),
            lambda: uncertain.why(factor=0), lambda: uncertain.gate(draft), lambda: uncertain.gain(draft),
            lambda: uncertain.associate(key, "landmark_se2", [[1.0, 2.0]], information=np.eye(2)),
            lambda: own.chi2(batch=True), own.repair,
        ]  # fmt: skip
        if key != self._key(n - 1):
            self._chance.choice(questions)()

    def _change(self, _: Bus, own: Map, n: int) -> None:
        key, factor = self._some(n), self._chance.randrange(1, n + 1)
        own.change(
            self._chance.choice(
                [
                    Changes().fix(key), Changes().free(key), Changes().loss([factor], "cauchy", 2.0),
                    Changes().weigh([factor], self._chance.choice((0.5, 2.0))), Changes().remove_factors([factor]),
                ]
            )
        )  # fmt: skip

    def _undo(self, _: Bus, own: Map, n: int) -> None:
        draft = Draft().between_se2(self._key(n - 1), self._key(n), (1, 0, 0.1), sigmas=SIGMAS)
        own.change(Changes().undo(draft, own.insert(draft)))

    def _fork(self, bus: Bus, own: Map, n: int) -> None:
        fork = f"{self.name_here}-fork"
        bus.fork(self.name_here, fork)
        with bus.map(fork, create=False) as branch:
            branch.insert(Draft().between_se2(self._key(n - 1), self._key(n), (1, 0, 0.1), sigmas=SIGMAS))
            branch.chi2()
        bus.drop(fork)

    def _beside_too(self, bus: Bus, own: Map, n: int) -> None:
        """Into the map of another."""
        with bus.map(self._beside, create=False, mirror=False) as other:
            key = f"{self._letter}{10**6 + self._chance.randrange(10**9)}"
            other.insert(Draft().se2(key, (0, 0, 0)).prior_se2(key, (0, 0, 0), sigmas=SIGMAS))
            other.chi2()

    def _list(self, bus: Bus, *_: Any) -> None:
        bus.maps()
        bus.stats()


_OTHERS: dict[str, tuple[int, Callable[..., None]]] = {
    "ask": (60, Client._ask), "change": (20, Client._change), "undo": (5, Client._undo), "fork": (3, Client._fork),
    "beside": (8, Client._beside_too), "list": (4, Client._list),
}  # fmt: skip


class Service:
    """The service under it, and what it has."""

    def __init__(self, start: Any, folder: Path) -> None:
        self._start, self._journal = start, folder / "journal"
        self.process: Process
        self.endpoint = self.again()

    def again(self) -> str:
        """Start it; where it answers."""
        options = ("--listen", "tcp/127.0.0.1:0", "--journal", str(self._journal))
        self.process = self._start("-m", "factorbus.service", *options)
        self.endpoint = self.process.ready()[0]
        return self.endpoint

    def kill(self) -> None:
        """Without a word."""
        self.process.signal(signal.SIGKILL)
        self.process.wait()

    def has(self) -> dict[str, int]:
        """Resident bytes, open files, files on disk."""
        pid = self.process.pid
        return {
            "memory": resident(pid),
            "open": len(list(Path(f"/proc/{pid}/fd").iterdir())),
            "on_disk": sum(1 for path in self._journal.rglob("*") if path.is_file()),
        }


def estimates(bus: Bus) -> dict[str, dict[int, bytes]]:
    """Every map at rest: values by key, bit for bit."""
    found = {}
    for row in bus.maps(_PATIENCE_S):
        with bus.map(row.name, create=False, mirror=False) as joined:
            groups = joined.ask_estimate(timeout_s=_PATIENCE_S).variables
            found[row.name] = {
                int(key): value.tobytes()
                for group in groups
                for key, value in zip(group.keys, np.asarray(group.values), strict=True)
            }
    return found


def at_rest(bus: Bus) -> None:
    """No map goes on by itself any more."""
    for row in bus.maps(_PATIENCE_S):
        with bus.map(row.name, create=False) as joined:
            joined.wait_converged(_PATIENCE_S)


def run(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """All rounds."""
    done, codes, faults = Counter[str](), Counter[str](), list[str]()
    began, has, number = time.monotonic(), list[dict[str, int]](), 0
    with ExitStack() as stack:
        service = Service(stack.enter_context(processes(folder)), folder)
        # One at least that ends with its maps dropped, and the last, whose maps have to be there after the kill.
        rounds = max(options.rounds or round(60 * options.minutes / options.round_s), 2)
        for number in range(rounds):
            _round(service.endpoint, options, options.seed + 1000 * number, (done, codes, faults))
            if number == rounds - 1:
                break
            with connect(service.endpoint, client="keeper", timeout_s=_PATIENCE_S) as bus:
                for row in bus.maps():
                    bus.drop(row.name, timeout_s=_PATIENCE_S)
            has.append(service.has())
            print(f"round {number}: {has[-1]}, {sum(done.values())} done", file=sys.stderr, flush=True)
        with connect(service.endpoint, client="keeper", timeout_s=_PATIENCE_S) as bus:
            at_rest(bus)
            before = estimates(bus)
            service.kill()
            service.again()
        with connect(service.endpoint, client="keeper", timeout_s=_PATIENCE_S) as bus:
            after = estimates(bus)
    memory = [each["memory"] for each in has]
    third = max(len(memory) // 3, 1)
    return {
        "seed": options.seed, "clients": options.clients, "rounds": number + 1,
        "seconds": round(time.monotonic() - began, 1), "done": dict(done), "codes": dict(codes), "faults": faults[:20],
        "memory_mb": [round(each / 1e6, 1) for each in memory],
        "growth": round(max(memory[-third:]) / max(memory[-2 * third : -third] or memory), 3), "goal": GOAL_GROWTH,
        "open_files": [each["open"] for each in has], "files_on_disk": [each["on_disk"] for each in has],
        "maps_after_the_kill": len(after), "same_bits": before == after,
    }  # fmt: skip


def _round(endpoint: str, options: argparse.Namespace, seed: int, found: tuple[Counter, Counter, list[str]]) -> None:
    """All clients for so long."""
    done, codes, faults = found
    clients = [Client(endpoint, number, options.clients, seed) for number in range(options.clients)]
    for client in clients:
        client.start()
    time.sleep(options.round_s)  # a load that lasts
    for client in clients:
        client.stop()
    for client in clients:
        client.join(2 * _PATIENCE_S)
        done.update(client.done)
        codes.update(client.codes)
        faults.extend([*client.faults, *(["it does not end"] if client.is_alive() else [])])


def held(result: dict[str, Any]) -> bool:
    """Is the goal met?"""
    flat = all(max(result[name]) <= 1.2 * min(result[name]) for name in ("open_files", "files_on_disk"))
    return flat and result["growth"] <= GOAL_GROWTH and result["same_bits"] and not result["faults"]


def main() -> int:
    """1: a fault, growth, or other bits after the kill."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--clients", type=int, default=6)
    parser.add_argument("--round-s", type=float, default=20.0)
    parser.add_argument("--rounds", type=int, default=0, help="in place of --minutes; two at least")
    parser.add_argument("--seed", type=int, default=random.randrange(2**31))
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    logging.getLogger("factorbus").setLevel(logging.ERROR)  # exports say what they leave out
    with tempfile.TemporaryDirectory() as folder:
        result = run(options, Path(folder))
    print_figures(result, options.json)
    return 0 if held(result) else 1


if __name__ == "__main__":
    sys.exit(main())
