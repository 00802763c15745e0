"""A map at work: which thread applies an insert, in what order its messages leave, and how it ends."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
import pytest

from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Delta, Factors, Insert, Variables
from factorbus.proto.symbols import parse_symbol
from factorbus.service.config import Limits
from factorbus.service.core.events import Answer, Arrived, Drained, Effect, ParsedInsert, Publish, Refuse
from factorbus.service.core.map_state import MapCore
from factorbus.service.maps.host import Host
from factorbus.service.maps.serial_executor import SerialExecutor
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import message_digest, read_insert
from factorbus.solver import Options, Solver

PATIENCE_S = 120.0
EPOCH = 5


class Told:
    """What a host had done, and by which thread."""

    def __init__(self) -> None:
        self.effects: list[tuple[Effect, str]] = []
        self._more = threading.Condition()

    def take(self, effects: list[Effect]) -> None:
        with self._more:
            self.effects += [(effect, threading.current_thread().name) for effect in effects]
            self._more.notify_all()

    def take_both(self, asker: Any, answer: bytes, delta: bytes) -> None:
        self.take([Answer(asker, answer), Publish("delta", delta)])

    def wait_for(self, happened: Callable[[], bool]) -> None:
        with self._more:
            assert self._more.wait_for(happened, PATIENCE_S)

    def has(self, kind: type) -> Callable[[], bool]:
        return lambda: any(isinstance(effect, kind) for effect, _ in self.effects)

    def answers(self) -> list[Answer]:
        return [effect for effect, _ in self.effects if isinstance(effect, Answer)]

    def deltas(self) -> list[Delta]:
        published = [e for e, _ in self.effects if isinstance(e, Publish) and e.channel == "delta"]
        return [codec.decode_delta(effect.message) for effect in published]

    def threads(self) -> list[str]:
        """Which thread told of each delta."""
        return [name for effect, name in self.effects if isinstance(effect, Publish) and effect.channel == "delta"]


class Held(Solver):
    """A solver that says when it steps, and waits for leave."""

    def __init__(self) -> None:
        super().__init__(Options(clock=time.perf_counter))
        self.begun, self.leave = threading.Semaphore(0), threading.Event()
        self.leave.set()

    def step(self, settle: bool = False, budget: float | None = None) -> Any:
        self.begun.release()
        assert self.leave.wait(PATIENCE_S)
        return super().step(settle, budget)


class Setup:
    """A host with a real solver."""

    def __init__(self) -> None:
        self.told, self.inline_run, self.solver = Told(), threading.Lock(), Held()
        self.sequence = 0
        core = MapCore("m", "auto", EPOCH, Limits(), 0.0)
        map_solver = MapSolver(lambda: self.solver, EPOCH, Limits())
        self.host = Host(
            core,
            map_solver,
            self.told.take,
            self.told.take,
            lambda reads, taken: None,
            self.inline_run,
            self.told.take_both,
        )

    def arrived(self, content: Batch, settle: bool = False, client: str = "a", size: int = 100) -> Arrived:
        self.sequence += 1
        insert = Insert(self.sequence, content, settle)
        return Arrived([str(self.sequence)], client, self.sequence, 0, size, 0, insert, self.now())

    def now(self) -> float:
        """Later than a round trip after whatever was before, as if the client had waited for its answer."""
        return time.monotonic() + 1e-3

    def insert(self, content: Batch, **how: Any) -> None:
        """Send one, wait for its answer."""
        answers = len(self.told.answers())
        self.host.insert(self.arrived(content, **how))
        self.told.wait_for(lambda: len(self.told.answers()) > answers)
        # The answer is told before the InsertBatch ends, and until then the solver is not free.
        self.wait_until_free()

    def wait_until_free(self) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while self.host.core.stats(0.0)["in_solver"] and time.monotonic() < deadline:
            pass

    def until_short(self) -> None:
        """A map that has made a step, so that the next ones are short."""
        self.insert(start())


def start() -> Batch:
    return Batch((Variables("se2", keys("x0"), np.zeros((1, 3)), fixed=True),))


def pose(n: int) -> Batch:
    information = np.array([[100.0, 0, 0, 100, 0, 400]])
    edge = Factors("between_se2", keys(f"x{n - 1}", f"x{n}")[None], np.array([[1.0, 0.0, 0.1]]), information)
    return Batch((Variables("se2", keys(f"x{n}")),), (edge,))


def keys(*names: str) -> np.ndarray:
    return np.array([parse_symbol(name) for name in names], np.int64)


@pytest.fixture(autouse=True)
def no_step_is_slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever this machine does meanwhile."""
    monkeypatch.setattr("factorbus.service.core.short_batches.SHORT_S", 1e9)


@pytest.fixture
def setup() -> Iterator[Setup]:
    made = Setup()
    yield made
    made.solver.leave.set()
    if not made.told.has(Drained)():
        made.host.stop()
    made.told.wait_for(made.told.has(Drained))
    made.host.end()


def test_a_short_run_is_done_by_who_brought_it_and_others_by_the_maps_thread(setup: Setup) -> None:
    setup.until_short()
    setup.insert(pose(1))
    setup.insert(pose(2), settle=True)
    setup.insert(pose(3), size=1 << 20)
    setup.insert(pose(4))
    here = threading.current_thread().name
    assert setup.told.threads() == ["solver m", here, "solver m", "solver m", here]
    assert not setup.inline_run.locked(), "given back"
    check(setup, 5)


def test_without_the_seat_a_short_run_goes_to_the_maps_thread(setup: Setup) -> None:
    setup.until_short()
    with setup.inline_run:
        setup.insert(pose(1))
    assert setup.told.threads() == ["solver m"] * 2
    check(setup, 2)


def test_what_comes_in_during_a_short_run_follows_it_on_the_maps_thread(setup: Setup) -> None:
    setup.until_short()
    setup.solver.leave.clear()
    setup.solver.begun = threading.Semaphore(0)
    first, others = setup.arrived(pose(1)), [setup.arrived(pose(2)), setup.arrived(pose(3))]
    bringing = threading.Thread(target=setup.host.insert, args=(first,), name="bringing")
    bringing.start()
    assert setup.solver.begun.acquire(timeout=PATIENCE_S)
    for other in others:
        setup.host.insert(other)  # returns while the solver is at work
    setup.solver.leave.set()
    bringing.join(PATIENCE_S)
    setup.told.wait_for(lambda: len(setup.told.answers()) == 4)
    assert setup.told.threads() == ["solver m", "bringing", "solver m"]
    accepted = [codec.decode_accepted(answer.message) for answer in setup.told.answers()]
    assert [(a.sequence, a.revision, a.applied) for a in accepted] == [(1, 1, 1), (2, 2, 1), (3, 3, 2), (4, 3, 2)]
    check(setup, 3)


def located(setup: Setup, content: Batch, asker: str = "") -> Arrived:
    """The same as it comes over the bus."""
    setup.sequence += not asker
    message = codec.encode_insert(Insert(setup.sequence, content))
    arrived = read_insert(asker or str(setup.sequence), "a", message, REQUEST_LIMITS, setup.now())
    assert isinstance(arrived, Arrived)
    assert isinstance(arrived.content, ParsedInsert)
    return arrived


def test_an_insert_read_where_it_lies_leaves_the_map_as_any_other(setup: Setup) -> None:
    other, sent = Setup(), dict[int, Batch]()
    for n in range(1, 30):
        batch = start() if n == 1 else pose(n - 1)
        if n % 9 == 0:
            batch = pose(1)  # refused
        sent[n] = batch
        setup.host.insert(located(setup, batch))
        message = codec.encode_insert(Insert(n, batch))
        arrived = other.arrived(batch, size=len(message))
        other.host.insert(arrived._replace(digest=message_digest(message), message=message))
        for one in (setup, other):
            one.told.wait_for(lambda one=one: len(said(one)) == one.sequence)
            one.wait_until_free()
    told, usual = ([codec.decode_accepted(a.message) for a in one.told.answers()] for one in (setup, other))
    assert [(a.sequence, a.revision, a.first_factor) for a in told] == [
        (a.sequence, a.revision, a.first_factor) for a in usual
    ]
    assert [type(effect) for effect in said(setup)] == [type(effect) for effect in said(other)]
    counted = [plain(one.host.core.operator_stats(0.0)) for one in (setup, other)]
    sizes = [row.pop("bytes") for row in counted]
    assert counted[0] == counted[1]
    assert sizes[0]["received"] == sizes[1]["received"]
    assert sizes[0]["answered"] == sum(len(a.message) for a in setup.told.answers())
    assert [one.host.core.stats(0.0)["clients"] for one in (setup, other)] == [{"a": 30}] * 2
    for one in (setup, other):
        for n, batch in sent.items():  # asked again: the answer it had; with another content it is refused
            message = codec.encode_insert(Insert(n, batch))
            again = one.arrived(batch, size=len(message))._replace(sequence=n, digest=message_digest(message))
            before = said(one)
            one.host.insert(again)
            assert [content(effect) for effect in said(one)[len(before) :]] == [content(before[n - 1])]
            one.host.insert(again._replace(digest=message_digest(message + b" ")))
            assert content(said(one)[-1]) == "bad_sequence"
    other.host.stop()
    other.told.wait_for(other.told.has(Drained))
    other.host.end()


def said(setup: Setup) -> list[Effect]:
    """The answers, good and bad."""
    return [effect for effect, _ in setup.told.effects if isinstance(effect, Answer | Refuse)]


def content(effect: Effect) -> bytes | str:
    """What an answer says, no matter who asked."""
    return effect.problem.code if isinstance(effect, Refuse) else cast(Answer, effect).message


def plain(stats: dict[str, Any]) -> dict[str, Any]:
    """Without times."""
    return {name: value for name, value in stats.items() if not name.endswith(("_s", "_ms"))}


def test_who_asks_again_while_it_is_folded_in_gets_the_same_answer(setup: Setup) -> None:
    setup.until_short()
    for n in (1, 2):
        setup.insert(pose(n))
    setup.solver.leave.clear()
    setup.solver.begun = threading.Semaphore(0)
    first = located(setup, pose(3))
    again = [located(setup, pose(3), asker) for asker in ("again", "and again")]
    bringing = threading.Thread(target=setup.host.insert, args=(first,), name="bringing")
    bringing.start()
    assert setup.solver.begun.acquire(timeout=PATIENCE_S)
    for arrived in again:
        setup.host.insert(arrived)
    setup.solver.leave.set()
    bringing.join(PATIENCE_S)
    setup.host.insert(located(setup, pose(3), "later"))
    answers = setup.told.answers()[3:]
    assert [answer.asker for answer in answers] == [str(setup.sequence), "again", "and again", "later"]
    assert len({answer.message for answer in answers}) == 1
    assert setup.told.threads()[-1] == "bringing"
    check(setup, 4)


def test_stopping_during_a_short_run_answers_it_first(setup: Setup) -> None:
    setup.until_short()
    setup.solver.leave.clear()
    setup.solver.begun = threading.Semaphore(0)
    bringing = threading.Thread(target=setup.host.insert, args=(setup.arrived(pose(1)),))
    bringing.start()
    assert setup.solver.begun.acquire(timeout=PATIENCE_S)
    setup.host.stop()
    setup.host.insert(setup.arrived(pose(2)))
    setup.solver.leave.set()
    bringing.join(PATIENCE_S)
    setup.told.wait_for(setup.told.has(Drained))
    kinds = [type(effect) for effect, _ in setup.told.effects if not is_event(effect)]
    assert kinds == [Answer, Publish, Refuse, Answer, Publish, Drained]
    check(setup, 2)


def test_a_fault_in_a_short_run_ends_the_map_and_tells_who_waits(setup: Setup, monkeypatch: pytest.MonkeyPatch) -> None:
    setup.until_short()

    def broken(map_solver: MapSolver, inserts: Any, further: bool) -> Any:
        raise RuntimeError("applying failed")

    monkeypatch.setattr(MapSolver, "apply_batch", broken)
    setup.host.insert(setup.arrived(pose(1)))
    setup.host.insert(setup.arrived(pose(2)))
    codes = [effect.problem.code for effect, _ in setup.told.effects if isinstance(effect, Refuse)]
    assert codes == ["internal", "internal"]
    assert not setup.inline_run.locked()
    assert setup.told.has(Drained)()


def test_an_idle_lane_is_not_needed_and_a_busy_one_keeps_the_order() -> None:
    executor, reached, leave = SerialExecutor("executor"), threading.Event(), threading.Event()
    done: list[tuple[int, str]] = []

    def do(number: int) -> None:
        done.append((number, threading.current_thread().name))
        if number == 2:
            reached.set()
            assert leave.wait(PATIENCE_S)
        if number == 4:
            raise ValueError("the executor logs it and goes on")

    here = threading.current_thread().name
    executor.hand_or_do(do, 1)
    executor.hand(do, 2)
    assert reached.wait(PATIENCE_S)
    executor.hand_or_do(do, 3)  # number 2 is begun, but not done
    executor.hand_or_do(do, 4)
    leave.set()
    executor.close()
    executor.hand_or_do(do, 5)
    assert done == [(1, here), (2, "executor"), (3, "executor"), (4, "executor"), (5, here)]


def is_event(effect: Effect) -> bool:
    return isinstance(effect, Publish) and effect.channel == "event"


def check(setup: Setup, revision: int) -> None:
    """Deltas left in order."""
    assert [(d.previous, d.revision) for d in setup.told.deltas()] == [(n, n + 1) for n in range(revision)]
