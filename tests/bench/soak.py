"""Hours in minutes: clients that stream, are killed, leave and come back, into a service that keeps everything.

    python tests/bench/soak.py [--inserts 1000000] [--clients 8] [--minutes M] [--durability commit] [--json]

Clients are processes of their own.  Each streams one pose and its odometry an insert, with a window; after hundreds or
thousands it leaves the bus and joins again, and every few seconds, and once on every map, one is killed (SIGKILL) and
another starts in its place.  What was sent and what was answered each client writes into memory that outlives it.  Maps
take turns: after `--rotate` inserts all clients leave and rest, everything is counted, the map is dropped, and the
memory is read: so it is that of a service, not that of a map, whatever size the maps came to.

Lost: answered, and not in the map.  Duplicated: more factors than the poses there would have, or more inserts in the
journal than poses.  Memory: resident, with no map, fitted over the second half of the maps: what the
allocator keeps takes a while to settle; the fit from the third map on is given beside.
Goal: nothing lost, nothing duplicated, and the memory grows by less than 32 bytes an insert.
"""

import argparse
import os
import random
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from bench.results import print_figures
from process_memory import resident
from processes import Process, processes

from factorbus.client import Bus, Draft, connect
from factorbus.client.map import Map
from factorbus.journal.store import open_store
from factorbus.proto.symbols import parse_symbol

GOAL_BYTES = 32.0
KILL_EVERY_S = 4.0
LIVES = (300, 4000)  # inserts between joining and leaving
WINDOW = 32
SIGMAS = (0.1, 0.1, 0.05)
SENT, ANSWERED, BEGINS = 1, 2, 4
LETTERS = "abcdefghijklmnop"
_PATIENCE_S = 120.0
REST = "-"  # in place of a map: stay away from the bus


class Notes:
    """What one client did on one map: for each of its poses what became of it, and the µs until the answer."""

    def __init__(self, path: Path, size: int) -> None:
        if not path.exists():
            path.write_bytes(bytes(9 * size))
        kept = np.memmap(path, np.uint8, "r+", shape=(9 * size,))
        self.state, self.took_us = kept[:size], kept[size:].view(np.float64)

    def next(self) -> int:
        """The first pose that was not sent yet."""
        sent = np.flatnonzero(self.state)
        return int(sent[-1]) + 1 if sent.size else 0


# ---- a client -------------------------------------------------------------------------------------------------------


def drive(endpoint: str, letter: str, folder: Path, size: int, seed: int) -> None:
    """Reads the name of a map, streams into it until the next line; prints `left NAME`."""
    chance, ordered = random.Random(seed), _Orders()
    print("ready", flush=True)
    for name in iter(ordered.take, ""):
        notes = Notes(folder / f"{name}-{letter}", size) if name != REST else None
        while notes and not ordered.waiting() and notes.next() < size:
            with connect(endpoint, client=letter, timeout_s=_PATIENCE_S) as bus:
                _live(bus, name, letter, notes, min(chance.randint(*LIVES), size - notes.next()), ordered)
        print("left", name, flush=True)


def _live(bus: Bus, name: str, letter: str, notes: Notes, count: int, ordered: "_Orders") -> None:
    first = notes.next()
    with bus.map(name, window=WINDOW, mirror=False) as driven:
        for n in range(first, first + count):
            if ordered.waiting():
                break
            _send(driven, letter, n, n == first, notes)
        driven.flush(_PATIENCE_S)


def _send(driven: Map, letter: str, n: int, begins: bool, notes: Notes) -> None:
    """One pose: the first of a life is fixed, for what the life before had sent last need not be there."""
    if begins:
        draft = Draft().se2(f"{letter}{n}", (0, 0, 0), fixed=True)
    else:
        draft = Draft().se2(f"{letter}{n}")
        draft.between_se2(f"{letter}{n - 1}", f"{letter}{n}", (1, 0, 0.01), sigmas=SIGMAS)
    notes.state[n] = SENT | (BEGINS if begins else 0)
    pending_insert = driven.send(draft, timeout_s=_PATIENCE_S)

    def answered(_: object) -> None:
        if pending_insert.future.exception() is None:
            notes.took_us[n] = 1e6 * (pending_insert.round_trip_s or 0.0)
            notes.state[n] |= ANSWERED

    pending_insert.future.add_done_callback(answered)


class _Orders:
    """Lines of standard input, as they come."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._more = threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()

    def waiting(self) -> bool:
        """Is there another?"""
        return bool(self._lines)

    def take(self) -> str:
        """The next; empty at the end."""
        with self._more:
            self._more.wait_for(self.waiting)
            return self._lines.pop(0)

    def _read(self) -> None:
        for line in chain(sys.stdin, [""]):
            with self._more:
                self._lines.append(line.strip())
                self._more.notify()


# ---- who looks after them -------------------------------------------------------------------------------------------


class Fleet:
    """Clients in processes of their own, one after the other under each letter."""

    def __init__(self, start: Any, endpoint: str, letters: str, folder: Path, size: int) -> None:
        self._start, self._endpoint, self._folder, self._size = start, endpoint, folder, size
        self._letters, self._random = letters, random.Random(5)
        self._map, self.kills, self.born, self.killed_at = "", 0, 0, time.monotonic()
        self._running = {letter: self._bear(letter) for letter in letters}

    def go_to(self, name: str) -> None:
        """All stream into map `name` from now on (REST: none; empty: they end), and have left the one before."""
        before, self._map = self._map, name
        for each in self._running.values():
            each.tell(name)
        for each in self._running.values() if before else ():
            each.line(f"left {before}", _PATIENCE_S)

    def kill_one(self) -> None:
        """One goes without a word, and another takes its place."""
        letter = self._random.choice(self._letters)
        self._running[letter].end()
        self.kills, self.killed_at = self.kills + 1, time.monotonic()
        self._running[letter] = self._bear(letter)

    def _bear(self, letter: str) -> Process:
        self.born += 1
        options = ("--client", self._endpoint, letter, str(self._folder), str(self._size), str(self.born))
        process = self._start(str(Path(__file__).resolve()), *options)
        if self._map:
            process.tell(self._map)
        return process


class Account:
    """What was found, map by map."""

    def __init__(self) -> None:
        self.sent = self.answered = self.lost = self.duplicated = self.uncertain = 0
        self.took_us: list[np.ndarray] = []
        self.memory: list[tuple[int, int]] = []  # inserts answered by then, resident bytes

    def close(self, name: str, letters: str, folder: Path, journal: Path, present: set[int], factors: int) -> None:
        """Count what became of map `name`, which has `present` and `factors`."""
        begins = 0
        for letter in letters:
            path = folder / f"{name}-{letter}"
            if not path.exists():
                continue
            notes = Notes(path, path.stat().st_size // 9)
            sent = np.flatnonzero(notes.state)
            keys = np.array([parse_symbol(f"{letter}{n}") for n in sent], np.int64)
            there = np.array([int(key) in present for key in keys], bool)
            answered = (notes.state[sent] & ANSWERED) > 0
            self.sent += sent.size
            self.answered += int(answered.sum())
            self.lost += int((answered & ~there).sum())
            self.uncertain += int((there & ~answered).sum())
            begins += int((there & ((notes.state[sent] & BEGINS) > 0)).sum())
            self.took_us.append(notes.took_us[sent[answered]].copy())
            path.unlink()
        self.duplicated += abs(factors - (len(present) - begins))
        store = open_store(journal / name, read_only=True)
        try:
            self.duplicated += len(list(store.check())) + store.counts()["inserts"] - len(present)
        finally:
            store.close()

    def slope(self, skip: int) -> float:
        """Bytes of memory an insert, fitted over all but the first `skip` maps."""
        inserts, memory = np.array(self.memory[skip:], float).T if len(self.memory) > skip + 2 else np.zeros((2, 0))
        return float(np.polyfit(inserts, memory, 1)[0]) if inserts.size else float("nan")


def run(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Until this number of inserts is answered, or time is up."""
    letters, account, began = LETTERS[: options.clients], Account(), time.monotonic()
    with ExitStack() as stack:
        start = stack.enter_context(processes(folder))
        endpoint, pid = _serve(start, folder, options.durability)
        bus = stack.enter_context(connect(endpoint, client="keeper", timeout_s=_PATIENCE_S))
        fleet, number = Fleet(start, endpoint, letters, folder, 2 * options.rotate), 0
        while account.answered < options.inserts and time.monotonic() - began < 60 * options.minutes:
            name, number = f"soak-{number}", number + 1
            bus.create(name, timeout_s=_PATIENCE_S)
            fleet.go_to(name)
            _churn(bus, name, fleet, options.rotate, began + 60 * options.minutes)
            fleet.go_to(REST)
            _close(bus, name, letters, folder, account, pid)
        fleet.go_to("")
    took = np.concatenate(account.took_us) / 1e3
    seconds = time.monotonic() - began
    return {
        "inserts": account.answered, "wanted": options.inserts, "seconds": round(seconds, 1), "clients": len(letters),
        "durability": options.durability, "maps": number, "kills": fleet.kills, "processes": fleet.born,
        "lost": account.lost, "duplicated": account.duplicated, "there_but_not_answered": account.uncertain,
        "inserts_per_s": round(account.answered / seconds, 1),
        "answer_ms": {f"p{q}": round(float(np.percentile(took, q)), 2) for q in (50, 90, 99)},
        "answer_ms_max": round(float(took.max()), 1),
        "memory_mb": [round(each / 1e6, 1) for _, each in account.memory],
        "memory_bytes_per_insert": round(account.slope(number // 2), 2),
        "from_the_third_map_on": round(account.slope(2), 2),
        "goal_bytes_per_insert": GOAL_BYTES, "cores": os.cpu_count(), "load": os.getloadavg()[0],
    }  # fmt: skip


def _serve(start: Any, folder: Path, durability: str) -> tuple[str, int]:
    """Where it answers, and its process."""
    options = ("--journal", str(folder / "journal"), "--durability", durability)
    service: Process = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", *options)
    return service.ready()[0], service.pid


def _churn(bus: Bus, name: str, fleet: Fleet, rotate: int, end: float) -> None:
    """Kill one now and then, and at least one, until the map has enough."""
    before = fleet.kills
    while time.monotonic() < end:
        row = next(each for each in bus.maps() if each.name == name)
        full = row.variables >= rotate
        if time.monotonic() - fleet.killed_at > KILL_EVERY_S or (full and fleet.kills == before):
            fleet.kill_one()
        if full:
            return
        time.sleep(0.2)  # the map has no mirror here that would tell how far it is


def _close(bus: Bus, name: str, letters: str, folder: Path, account: Account, pid: int) -> None:
    """Everybody has left map `name`: count, look at the memory, drop it."""
    with bus.map(name, create=False, mirror=False) as left:
        estimate, factors = left.ask_estimate(timeout_s=_PATIENCE_S), int(left.stats()["factors"])
    present = {int(key) for group in estimate.variables for key in group.keys}
    account.close(name, letters, folder, folder / "journal", present, factors)
    bus.drop(name, timeout_s=_PATIENCE_S)
    account.memory.append((account.answered, resident(pid)))
    print(
        f"{name}: {account.answered} answered, {account.lost} lost, {account.duplicated} twice, "
        f"{account.memory[-1][1] / 1e6:.1f} MB", file=sys.stderr, flush=True,
    )  # fmt: skip


def main() -> int:
    """1: something was lost or came twice, or the memory grows."""
    if sys.argv[1:2] == ["--client"]:
        endpoint, letter, folder, size, seed = sys.argv[2:]
        drive(endpoint, letter, Path(folder), int(size), int(seed))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inserts", type=int, default=1_000_000)
    parser.add_argument("--clients", type=int, default=8)
    parser.add_argument("--minutes", type=float, default=240.0, help="stop after so long")
    parser.add_argument("--rotate", type=int, default=50_000, help="inserts into one map")
    parser.add_argument("--durability", choices=("commit", "group", "none"), default="commit")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        result = run(options, Path(folder))
    print_figures(result, options.json)
    flat = not result["memory_bytes_per_insert"] > GOAL_BYTES
    return 0 if not result["lost"] and not result["duplicated"] and flat else 1


if __name__ == "__main__":
    sys.exit(main())
