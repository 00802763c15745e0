"""A map that is ordered anew beside its steps: another solver takes the place, with all that the first one has."""

import queue
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorbus.journal.store import create
from factorbus.proto import codec
from factorbus.proto.limits import REQUEST_LIMITS
from factorbus.proto.messages import Batch, Change, Delta, Factors, Insert, Variables
from factorbus.service import reordering
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Effect, Judged, Outcome, Publish, Run, Stepped
from factorbus.service.core.map_state import MapCore
from factorbus.service.journal.recovery import verify
from factorbus.service.journal.writing import written
from factorbus.service.maps.host import Host
from factorbus.service.questions.answers import Question
from factorbus.service.reordering import Reordering
from factorbus.service.solving.apply import Folder
from factorbus.service.solving.arrival import read_insert
from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver

EPOCH, PATIENCE_S, PLENTY = 4, 120.0, 1 << 40
ALWAYS = 0.01  # R has this share of fresh numbers, and more


@pytest.fixture(autouse=True)
def small_maps_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reordering, "LEAST", 100)


class Driven:
    """A folder, what goes on beside it, and the steps by which another solver took the place."""

    def __init__(self, grown: float, room: int = PLENTY, **options: Any) -> None:
        self.folder = Folder(lambda: Solver(Options.of(**options)), EPOCH, Limits())
        self.beside = Reordering(self.folder, grown, lambda: room, "m")
        self.replaced: list[Stepped] = []
        self.outcomes: list[Outcome] = []
        self.journal: list[tuple[Sequence[Arrived], Sequence[Judged | Stepped], bool]] = []
        self.folds = 0

    def insert(self, content: Batch | tuple[Change, ...]) -> None:
        batch, changes = (content, ()) if isinstance(content, Batch) else (Batch(), content)
        self.fold([arrived(Insert(len(self.outcomes) + 1, batch, changes=changes))])

    def fold(self, inserts: Sequence[Arrived], further: bool = False) -> None:
        events, _ = self.folder.fold_whole(inserts, further)
        self.journal.append((inserts, events, further))
        self.outcomes += [o for event in events if isinstance(event, Judged) for o in event.outcomes]
        self.folds += bool(inserts or further)
        run = Run((), tuple(inserts), further=further)
        if (stepped := self.beside.after(run, events, self.folds)) is not None:
            self.replaced.append(stepped)
            self.journal.append(((), [stepped], False))
            self.folds += 1

    def wait(self) -> None:
        """Until the other solver is made."""
        assert self.beside._beside is not None
        self.beside._beside._thread.join(PATIENCE_S)
        assert not self.beside._beside._thread.is_alive()

    def values(self) -> dict[int, np.ndarray]:
        taken = self.folder.snapshot([Question("estimate")])
        return {int(key): row for g in taken.variables for key, row in zip(g.keys, g.values, strict=True)}


def arrived(insert: Insert) -> Arrived:
    made = read_insert(None, "a", codec.encode_insert(insert), REQUEST_LIMITS, 0.0)
    assert isinstance(made, Arrived)
    return made._replace(askers=[])


def shuffled(count: int) -> Iterator[Batch]:
    """All odometry of a simulated drive at once, and then its loops, one at a time and in no order."""
    steps = [step.batch for step in manhattan(count, 3)]
    first, *others = (group for batch in steps for group in batch.variables)
    poses = Variables("se2", np.concatenate([group.keys for group in others]))
    factors = [group for batch in steps for group in batch.factors]
    edges = [(f.keys[n : n + 1], f.measured[n : n + 1], f.information[n : n + 1])
             for f in factors for n in range(len(f.keys))]  # fmt: skip
    loops = [edge for edge in edges if abs(int(edge[0][0, 1] - edge[0][0, 0])) != 1]
    assert len(loops) > len(poses.keys) // 4
    drive = [edge for edge in edges if abs(int(edge[0][0, 1] - edge[0][0, 0])) == 1]
    yield Batch((first, poses), (between(drive),))
    for k in np.random.default_rng(1).permutation(len(loops)).tolist():
        yield Batch((), (between([loops[k]]),))


def stamped(batch: Batch, n: int) -> Batch:
    """The n-th pose and its time."""
    own = (group._replace(stamps=np.full(group.keys.size, 7 + n)) for group in batch.variables)
    return batch._replace(variables=tuple(own))


def between(edges: list[tuple[np.ndarray, ...]]) -> Factors:
    return Factors("between_se2", *(np.concatenate(column) for column in zip(*edges, strict=True)))


def read(stepped: Stepped) -> Delta:
    return codec.decode_delta(stepped.delta)


def unknown(like: Batch) -> Batch:
    """A factor between poses that are not there."""
    return Batch((), (Factors("between_se2", np.array([[-1, -2]]), np.zeros((1, 3)), like.factors[0].information[:1]),))


@pytest.fixture
def leave(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """The other solver is not made before this is set."""
    given, order_anew = threading.Event(), Solver.order_anew

    def waiting(solver: Solver, content: Any) -> Any:
        assert given.wait(PATIENCE_S)
        return order_anew(solver, content)

    monkeypatch.setattr(Solver, "order_anew", waiting)
    return given


def test_it_takes_the_place_with_what_came_meanwhile(leave: threading.Event) -> None:
    driven, plain = Driven(ALWAYS), Driven(0.0)
    batches = [stamped(step.batch, n) for n, step in enumerate(manhattan(400, 1))]
    n = 0
    while not driven.replaced:
        for one in (driven, plain):
            one.insert(batches[n])
            if n == 130:
                one.insert(unknown(batches[1]))
        if n == 150:
            assert driven.beside.busy
            leave.set()
            driven.wait()
        n += 1
    assert n > 151, "what had been noted was not followed at once"
    assert not driven.beside.busy
    (stepped,) = driven.replaced
    delta = read(stepped)
    assert (delta.previous, delta.revision) == (0, driven.folder.revision)
    assert driven.folder.revision == plain.folder.revision + 1
    assert delta.report["strategy"] == "full"
    assert "fresh order" in delta.report["because"]
    assert driven.folder.size == plain.folder.size
    there, known = driven.values(), plain.values()
    told = {int(k): row for g in delta.variables for k, row in zip(g.keys, g.values, strict=True)}
    assert {key: row.tobytes() for key, row in told.items()} == {key: row.tobytes() for key, row in there.items()}
    times = {
        int(k): int(t) for g in delta.variables if g.stamps is not None for k, t in zip(g.keys, g.stamps, strict=True)
    }
    assert times == {key: 7 + (key & 0xFFFF) for key in told}, "its delta tells all time stamps anew"
    assert there.keys() == known.keys()
    assert max(np.abs(there[key] - known[key]).max() for key in there) < 1e-2
    assert driven.folder.chi2() == pytest.approx(plain.folder.chi2(), rel=1e-3)
    for batch in batches[n:]:
        driven.insert(batch)
        plain.insert(batch)
    assert [isinstance(o.answer, bytes) for o in driven.outcomes] == [
        isinstance(o.answer, bytes) for o in plain.outcomes
    ]
    assert driven.folder.chi2() == pytest.approx(plain.folder.chi2(), rel=1e-3)


def test_further_steps_are_followed_and_made_again(leave: threading.Event, tmp_path: Path) -> None:
    """Steps without an insert, between the copy and the place taken: the journal leads to the same bits."""
    driven = Driven(ALWAYS)
    batches = [step.batch for step in manhattan(300, 1)]
    n = 0
    while not driven.replaced:
        driven.insert(batches[n])
        driven.fold((), further=n % 3 == 0)
        if n == 120:
            assert driven.beside.busy
            leave.set()
            driven.wait()
        n += 1
    for batch in batches[n : n + 20]:
        driven.insert(batch)
        driven.fold((), further=True)
    store = create(tmp_path / "m", "m", "bayes-tree", {}, EPOCH, "none")
    for inserts, events, further in driven.journal:
        if inserts or events:
            last = store.last()
            store.append([written(last.fold + 1, inserts, events, last, further)])
    copied, took = min(store.reordered().items())
    assert any(fold.further and fold.number < took for fold in store.folds(copied))
    again = Folder(lambda: Solver(Options()), EPOCH, Limits())
    assert all(same for _, same in verify(store, again))
    assert (again.revision, again.chi2()) == (driven.folder.revision, driven.folder.chi2())
    store.close()


def test_where_loops_come_in_no_order_r_is_smaller_for_it() -> None:
    driven, plain = Driven(1.05), Driven(0.0)
    batches = shuffled(600)
    while not driven.replaced:
        batch = next(batches)
        for one in (driven, plain):
            one.insert(batch)
        if driven.beside.busy:
            driven.wait()
    assert driven.folder.nonzeros < 0.97 * plain.folder.nonzeros
    assert driven.folder.chi2() == pytest.approx(plain.folder.chi2(), rel=1e-3)


def test_where_r_has_not_grown_nothing_takes_the_place() -> None:
    driven = Driven(1.5)
    for step in manhattan(300, 1):
        driven.insert(step.batch)
        if driven.beside.busy:
            driven.wait()
    assert not driven.replaced
    assert driven.beside._looked > 20


@pytest.mark.parametrize(
    ("grown", "room", "options"), [(0.0, PLENTY, {}), (ALWAYS, 1000, {}), (ALWAYS, PLENTY, {"mode": "inc-l"})]
)
def test_it_is_not_begun(grown: float, room: int, options: dict[str, Any]) -> None:
    """Where it is not wanted, there is no memory for it, or no R that is kept from step to step."""
    driven = Driven(grown, room, **options)
    for step in manhattan(150, 1):
        driven.insert(step.batch)
        assert not driven.beside.busy


def test_a_map_to_which_nothing_comes_any_more_has_it_with_the_next_tick() -> None:
    deltas: queue.SimpleQueue[Delta] = queue.SimpleQueue()

    def perform(effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Publish) and effect.channel == "delta":
                deltas.put(codec.decode_delta(effect.message))

    folder = Folder(lambda: Solver(Options()), EPOCH, Limits())
    beside, core = Reordering(folder, ALWAYS, lambda: PLENTY, "m"), MapCore("m", "auto", EPOCH, Limits(), 0.0)
    host = Host(
        core, folder, perform, perform, lambda reads, taken: None, threading.Lock(),
        lambda asker, answer, delta: deltas.put(codec.decode_delta(delta)), None, beside,
    )  # fmt: skip
    drive, *loops = shuffled(400)
    everything = Batch(drive.variables, (*drive.factors, *(factors for loop in loops for factors in loop.factors)))
    try:
        host.insert(arrived(Insert(1, everything))._replace(askers=["first"]))
        assert deltas.get(timeout=PATIENCE_S).revision == 1
        because = ""
        while "fresh order" not in because:  # further steps may come in between
            host.tick()
            because = "" if deltas.empty() else deltas.get().report["because"]
        assert not beside.busy
    finally:
        host.end()


def test_a_change_that_is_made_anew_lets_it_go() -> None:
    driven = begun()
    driven.wait()
    driven.insert((Change("fix", keys=np.array([int(driven.folder.solver._graph.keys[5])])),))
    assert not driven.beside.busy
    assert not driven.replaced


def test_a_change_of_factors_is_given_to_the_other_one_as_well() -> None:
    driven = begun()
    driven.wait()
    driven.insert((Change("weigh", np.array([0]), weight=np.array([0.5])),))
    driven.insert((Change("loss", np.array([1]), loss="huber", scale=np.ones(1)),))
    while not driven.replaced:
        assert driven.beside.busy
        driven.insert((Change("weigh", np.array([0]), weight=np.array([1.5])),))
    graph = driven.folder.solver.graph()[1]
    assert [group.ids.tolist() for group in graph if group.loss] == [[1]]


def begun() -> Driven:
    """A drive until the other solver is under way."""
    driven = Driven(ALWAYS)
    for step in manhattan(150, 1):
        driven.insert(step.batch)
        if driven.beside.busy:
            break
    assert driven.beside.busy
    return driven


def test_what_was_refused_for_a_limit_is_not_given_to_the_other(leave: threading.Event) -> None:
    driven = Driven(ALWAYS)
    batches = [step.batch for step in manhattan(150, 1)]
    for batch in batches[:101]:
        driven.insert(batch)
    assert driven.beside.busy
    driven.folder._limits = Limits(variables=driven.folder.size[0])
    driven.insert(batches[101])
    assert not isinstance(driven.outcomes[-1].answer, bytes)
    driven.folder._limits = Limits()
    leave.set()
    driven.wait()
    for batch in batches[101:]:
        driven.insert(batch)
    assert driven.replaced


def test_a_solver_that_fails_beside_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(self: Solver, content: object) -> None:
        raise MemoryError

    monkeypatch.setattr(Solver, "order_anew", failing)
    driven = Driven(ALWAYS)
    for step in manhattan(150, 1):
        driven.insert(step.batch)
        if driven.beside.busy:
            driven.wait()
    assert not driven.replaced
    assert all(isinstance(outcome.answer, bytes) for outcome in driven.outcomes)
    known_pose = Variables("se2", np.array([-5]), np.zeros((1, 3)), fixed=True)
    driven.insert(Batch((known_pose,)))
    assert isinstance(driven.outcomes[-1].answer, bytes)
