"""Mutated messages against everything that reads messages: nothing but an answer or a problem may come of them.

decoders    every decoder gets every kind of message
admission   inserts go through decoding, admission and a real solver; a refused one must leave every bit of the map as
            it was.  What was accepted, and only that, goes into a second solver, which must hold the same; its numbers
            are the same to the bit unless a step failed and was taken back (rounding), which is counted
live        a service in a process of its own gets them on every key, over the bus; every query must end with an answer
            or a problem, and a map that an honest client fills meanwhile must have the bits of one filled in peace

python tests/bench/fuzz.py [--messages 1000000] [--inserts 300000] [--live 100000] [--seed 1] [--json]
"""

import argparse
import json
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from bare import Bare, bare
from bench.mutants import Mutator, good_insert
from processes import processes

from factorbus.proto import codec, features_codec, keys
from factorbus.proto.limits import MessageLimits as MessageLimits
from factorbus.proto.messages import Batch, Insert, MapGraph
from factorbus.proto.problems import Problem, Refused
from factorbus.service.config import Limits
from factorbus.service.core.events import Answer, Applied, Arrived, InsertBatch, Refuse, Stepped, Verdict
from factorbus.service.core.map_state import MapCore
from factorbus.service.questions.answers import Question
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import read_insert
from factorbus.solver import Options, Solver

DECODERS: tuple[Callable[[bytes], Any], ...] = (
    codec.decode_insert, codec.decode_accepted, codec.decode_estimate, codec.decode_delta, codec.decode_graph,
    codec.decode_chi2, codec.decode_job, codec.decode_job_done, codec.decode_optimum, codec.decode_problem,
    codec.decode_keys_asked, codec.decode_map, features_codec.decode_ask, features_codec.decode_shard,
    features_codec.decode_shard_done, features_codec.decode_answer,
)  # fmt: skip
LIMITS = Limits(message_bytes=1 << 20)
SMALL = MessageLimits(1 << 20, 10_000, 10_000)
EPOCH = 7
_POSES = 60  # a map is compared and begun anew at this number
_MESSAGES = 500  # or messages: an accepted mutant may have spoilt it for all that follow
_IN_FLIGHT = 64
_PATIENCE_S = 60.0


@dataclass
class Outcome:
    """What came of some messages.  slowest_ms: of one message; answers: by code, or `ok`."""

    messages: int = 0
    seconds: float = 0.0
    slowest_ms: float = 0.0
    answers: Counter[str] = field(default_factory=Counter)
    faults: list[str] = field(default_factory=list)


def decoders(messages: int, seed: int) -> Outcome:
    """Every decoder gets every kind of message."""
    mutator, outcome = Mutator(seed), Outcome()
    started = time.perf_counter()
    for _ in range(messages):
        data, decode = mutator.any_message(), mutator.random.choice(DECODERS)
        begun = time.perf_counter()
        try:
            decode(data)
            outcome.answers["ok"] += 1
        except Problem as problem:
            outcome.answers[problem.code] += 1
        except Exception as error:
            outcome.faults.append(f"{decode.__name__}: {error!r} of {data[:200].hex()}")
        outcome.slowest_ms = max(outcome.slowest_ms, 1e3 * (time.perf_counter() - begun))
        outcome.messages += 1
    outcome.seconds = time.perf_counter() - started
    return outcome


class _Map:
    """One map as the service has it, short of bus and threads, and a record of what it accepted."""

    def __init__(self) -> None:
        self.core = MapCore("fuzzed", "auto", EPOCH, LIMITS, 0.0)
        self.map_solver = _folder()
        self.accepted: list[list[Arrived]] = []  # by step
        self.answers: dict[int, list[str]] = {}
        self.next: Counter[str] = Counter()
        self.bits = _bits(self.map_solver)
        self._took = False

    def insert(self, asker: int, client: str, data: bytes) -> str:
        """The answer's code, or `ok`."""
        self.answers[asker] = []
        read = read_insert(asker, client, data, SMALL, time.monotonic())
        self._perform([read] if isinstance(read, Refuse) else self.core.insert(read))
        if isinstance(read, Arrived):
            self.next[client] = self.core.stats(0.0)["clients"].get(client, 1)
        said = self.answers[asker]
        if len(said) > 1 or (not said and not self.core.stats(0.0)["parked"]):
            raise AssertionError(f"{len(said)} answers to one message: {said}")
        return said[0] if said else "parked"

    def _perform(self, effects: list[Any]) -> None:
        for effect in effects:
            match effect:
                case Answer(asker, _):
                    self.answers[asker].append("ok")
                case Refuse(asker, problem):
                    codec.encode_problem(problem)
                    self.answers[asker].append(problem.code)
                case InsertBatch():
                    self._run(effect)

    def _run(self, run: InsertBatch) -> None:
        for event in self.map_solver.apply(run.inserts):
            if isinstance(event, Verdict):
                if taken := [each.insert for each in event.outcomes if isinstance(each.answer, bytes)]:
                    self.accepted.append(taken)
                    self._took = True
                self._perform(self.core.give_verdict(event))
            elif isinstance(event, Stepped):
                self._perform(self.core.stepped(event))
            elif isinstance(event, Applied):
                bits = _bits(self.map_solver)
                if bits != self.bits and not self._took:
                    raise AssertionError("refused, and the map is not what it was")
                self.bits, self._took = bits, False
                self._perform(self.core.applied(event))

    def compare(self) -> str:
        """Beside a map that got only what was accepted, by step: `same bits`, `same content`, or else `different`."""
        fresh = _folder()
        for inserts in self.accepted:
            list(fresh.apply(inserts))
        theirs = _bits(fresh)
        return (
            "same bits" if self.bits == theirs else "same content" if _same_content(self.bits, theirs) else "different"
        )


def admission(messages: int, seed: int) -> Outcome:
    """Inserts through decoding, admission and the solver."""
    mutator, outcome, here = Mutator(seed), Outcome(), _Map()
    started = time.perf_counter()
    for number in range(messages):
        client = mutator.random.choice("abcd")
        sequence = max(1, here.next[client] or 1)
        if mutator.random.random() < 0.03:
            sequence = mutator.random.choice((1, sequence - 1 or 1, sequence + 1000, 2**62))
        have = here.core.variables
        data = mutator.insert(sequence, good_insert(mutator.random, have))
        begun = time.perf_counter()
        try:
            outcome.answers[here.insert(number, client, data)] += 1
        except Exception as error:
            outcome.faults.append(f"{error!r} of {data[:200].hex()}")
            here = _Map()
        outcome.slowest_ms = max(outcome.slowest_ms, 1e3 * (time.perf_counter() - begun))
        outcome.messages += 1
        if here.core.variables > _POSES or number % _MESSAGES == _MESSAGES - 1 or number == messages - 1:
            outcome.answers[f"maps, {(found := here.compare())}"] += 1
            if found == "different":
                outcome.faults.append(f"seed {seed}, message {number}: the map has not what was accepted")
            here = _Map()
    outcome.seconds = time.perf_counter() - started
    return outcome


def live(messages: int, seed: int) -> Outcome:
    """A service in a process of its own gets them on every key."""
    outcome, started = Outcome(), time.perf_counter()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        start = stack.enter_context(processes(folder))
        settings = folder / "serve.toml"
        settings.write_text("[limits]\nparked_s = 0.02\nclient_idle_s = 0.1\n")
        service = start(
            "-m",
            "factorbus.service",
            "--listen",
            "tcp/127.0.0.1:0",
            "--name",
            "s1",
            "--config",
            str(settings),
            "--no-warm",
        )
        endpoint = service.ready()[0]
        hostile, honest = (stack.enter_context(bare(endpoint)) for _ in range(2))
        for name in ("fuzzed", "honest", "peaceful"):
            honest.create(name)
        ending = threading.Event()
        filled: list[Batch] = []
        filler = threading.Thread(target=_fill, args=(honest, ending, filled, outcome))
        filler.start()
        try:
            _flood(hostile, messages, seed, outcome)
        finally:
            ending.set()
            filler.join(_PATIENCE_S)
        for sequence, batch in enumerate(filled, 1):
            honest.ask(keys.insert_key("peaceful", "a"), codec.encode_insert(Insert(sequence, batch)))
        left, right = (codec.decode_estimate(honest.estimate(name)) for name in ("honest", "peaceful"))
        if codec.encode_estimate(replace(left, epoch=0)) != codec.encode_estimate(replace(right, epoch=0)):
            outcome.faults.append("the honest client's map differs from one filled in peace")
        outcome.answers["honest inserts"] = len(filled)
        if "fault" in (said := (folder / "0.log").read_text()):
            outcome.faults += [line for line in said.splitlines() if "fault" in line][:10]
    outcome.seconds = time.perf_counter() - started
    return outcome


def _fill(honest: Bare, ending: threading.Event, filled: list[Batch], outcome: Outcome) -> None:
    random_ = Mutator(0).random
    have = 0
    while not ending.wait(0.05):
        batch = good_insert(random_, have)
        answer = honest.ask(keys.insert_key("honest", "a"), codec.encode_insert(Insert(len(filled) + 1, batch)))
        if not isinstance(answer, bytes):
            outcome.faults.append(f"an honest insert was not taken: {answer!r}")
            return
        filled.append(batch)
        have = max(have, 1) + sum(len(group.keys) for group in batch.variables) - (have == 0)


def _flood(hostile: Bare, messages: int, seed: int, outcome: Outcome) -> None:
    mutator = Mutator(seed)
    inserts = 0
    waiting: list[tuple[str, float, SimpleQueue[Any]]] = []
    places = [
        *(keys.ask_key("fuzzed", question) for question in (*keys.QUESTIONS, "weather")),
        *(keys.admin_key(operation) for operation in ("maps", "create", "stats")),
        keys.features_key("s1"),
        f"{keys.PREFIX}/map/nowhere/ask/stats",
        f"{keys.PREFIX}/map/fuzzed/in/a.b",
    ]
    for _ in range(messages):
        if mutator.random.random() < 0.7:
            # A message whose number cannot be read leaves a gap, so that a client is soon worth nothing.
            client, sequence = f"c{inserts // 10}", inserts % 10 + 1
            inserts += 1
            key, data = keys.insert_key("fuzzed", client), mutator.insert(sequence, good_insert(mutator.random, 0))
        else:
            key, data = mutator.random.choice(places), mutator.any_message()
        waiting.append((key, time.perf_counter(), hostile.send(key, data)))
        if len(waiting) >= _IN_FLIGHT:
            _collect(waiting.pop(0), outcome)
    for each in waiting:
        _collect(each, outcome)


def _collect(sent: tuple[str, float, "SimpleQueue[Any]"], outcome: Outcome) -> None:
    key, at, came = sent
    answer = came.get(timeout=_PATIENCE_S)
    outcome.messages += 1
    outcome.slowest_ms = max(outcome.slowest_ms, 1e3 * (time.perf_counter() - at))
    if answer is None:
        outcome.faults.append(f"silence on {key}")
    else:
        outcome.answers[answer.code if isinstance(answer, Refused) else "ok"] += 1


def _folder() -> MapSolver:
    return MapSolver(lambda: Solver(Options()), EPOCH, LIMITS)


def _bits(map_solver: MapSolver) -> bytes:
    taken = map_solver.snapshot([Question("graph")])
    return codec.encode_graph(taken.graph)


def _same_content(ours: bytes, theirs: bytes) -> bool:
    """The same variables, and the same factors to the bit."""
    left, right = (codec.decode_graph(each).batch for each in (ours, theirs))
    return [(g.kind, g.fixed, g.keys.tobytes()) for g in left.variables] == [
        (g.kind, g.fixed, g.keys.tobytes()) for g in right.variables
    ] and codec.encode_graph(MapGraph(0, 0, Batch((), left.factors))) == codec.encode_graph(
        MapGraph(0, 0, Batch((), right.factors))
    )


def main() -> int:
    """1: something but an answer or a problem came of a message."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=1_000_000)
    parser.add_argument("--inserts", type=int, default=300_000)
    parser.add_argument("--live", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    outcomes = {
        "decoders": decoders(options.messages, options.seed),
        "admission": admission(options.inserts, options.seed),
        "live": live(options.live, options.seed),
    }
    if options.json:
        rows = {name: {**asdict(each), "answers": dict(each.answers)} for name, each in outcomes.items()}
        print(json.dumps(rows, indent=2))
    else:
        for name, each in outcomes.items():
            print(f"{name}: {each.messages} messages in {each.seconds:.0f} s, slowest {each.slowest_ms:.1f} ms")
            print("  " + ", ".join(f"{count} {code}" for code, count in each.answers.most_common()))
            for fault in each.faults[:20]:
                print(f"  FAULT {fault}")
    return 1 if any(each.faults for each in outcomes.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
