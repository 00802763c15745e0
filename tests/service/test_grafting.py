"""Records of another journal put into a map's own: real maps, real journals, no bus."""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.journal.problems import JournalFailed
from factorbus.journal.records import ACCEPTED, JournalRecord
from factorbus.journal.store import open_store
from factorbus.proto import codec
from factorbus.proto.messages import Accepted, Batch, Change, Delta, Insert
from factorbus.proto.problems import Problem
from factorbus.proto.records import JournalPlace
from factorbus.service.config import Config, Limits
from factorbus.service.core.events import Answer, Effect, Publish, Refuse
from factorbus.service.core.map_state import MapCore
from factorbus.service.journal.grafting import Graft, Grafted, sent_records
from factorbus.service.journal.keeping import Keeper
from factorbus.service.journal.library import Library, log_owner, open_library
from factorbus.service.maps.host import Host
from factorbus.service.solving.arrival import read_insert

PATIENCE_S = 60.0


class End:
    """A map with its journal, as one service has it."""

    def __init__(self, folder: Path) -> None:
        config = Config(journal=str(folder), warm=False)
        library = open_library(config, log_owner, threading.Event())
        assert isinstance(library, Library)
        self.library, self.folder = library, folder / "m"
        kept = library.open("m", Limits()) if library.has("m") else library.make("m", "bayes-tree", Limits())
        core = MapCore("m", kept.header.mode, kept.header.epoch, Limits(), 0.0)
        kept.restore(core)
        self.told: queue.SimpleQueue[Effect] = queue.SimpleQueue()
        self.deltas: list[Delta] = []
        self.numbers: dict[str, int] = {}
        self.solver = kept.map_solver
        self.host = Host(core, kept.map_solver, self._take, self._take, _no_reads, threading.Lock(), _no_both, kept)

    def insert(self, client: str, content: Batch, changes: tuple[Change, ...] = (), number: int = 0) -> Any:
        """Its answer: an Accepted, or the problem."""
        number = number or self.numbers.get(client, 0) + 1
        self.numbers[client] = max(number, self.numbers.get(client, 0))
        message = codec.encode_insert(Insert(number, content, changes=changes))
        arrived = read_insert(object(), client, message, Limits().message(), time.monotonic())
        assert not isinstance(arrived, Refuse)
        self.host.insert(arrived)
        return self._answer()

    def graft(self, graft: Graft) -> Grafted:
        """Raises the problem that it was refused with."""
        done: list[Grafted] = []
        self.host.graft(object(), graft._replace(heard=done.append))
        if isinstance(answer := self._answer(raw=True), Problem):
            raise answer
        return done[0]

    def follow(self, upstream: "End", after: JournalPlace) -> Grafted:
        """Take what `upstream` has after a place."""
        records = sent_records(upstream.records(after.record), frozenset(), 1 << 30, 1 << 30)[0]
        return self.graft(Graft(after, records, upstream.place()))

    def push_to(self, upstream: "End", after: JournalPlace) -> Grafted:
        """Send what is here after a place."""
        records = sent_records(self.records(after.record), frozenset(), 1 << 30, 1 << 30)[0]
        return upstream.graft(Graft(after, records))

    def keeper(self) -> Keeper:
        assert self.host.keeper is not None
        return self.host.keeper

    def place(self) -> JournalPlace:
        self.keeper().settle()
        return JournalPlace(self.keeper().last.record, self.keeper().last.chain)

    def records(self, after: int = 0) -> list[JournalRecord]:
        self.keeper().settle()
        store = open_store(self.folder, read_only=True)
        try:
            return list(store.records(after))
        finally:
            store.close()

    def close(self) -> None:
        drained = threading.Event()
        self.drained = drained.set
        self.host.stop()
        assert drained.wait(PATIENCE_S)
        self.host.end()
        self.library.close()
        store = open_store(self.folder, read_only=True)
        assert list(store.check()) == []
        store.close()

    def _take(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Publish) and effect.channel == "delta":
                self.deltas.append(codec.decode_delta(effect.message))
            elif isinstance(effect, Answer | Refuse):
                self.told.put(effect)
            elif type(effect).__name__ == "Drained":
                self.drained()

    def _answer(self, raw: bool = False) -> Any:
        effect = self.told.get(timeout=PATIENCE_S)
        if isinstance(effect, Refuse):
            return effect.problem
        assert isinstance(effect, Answer)
        return effect.message if raw else codec.decode_accepted(effect.message)


def _no_reads(*_: Any) -> None:
    raise AssertionError("no question was asked")


def _no_both(*_: Any) -> None:
    raise AssertionError("with a journal nothing is sent in one")


@pytest.fixture
def ends(tmp_path: Path) -> Iterator[Callable[[str], End]]:
    """Ends by name; closed, and their journals checked, at the end."""
    made: list[End] = []

    def make(name: str) -> End:
        made.append(End(tmp_path / name))
        return made[-1]

    yield make
    for each in made:
        each.close()


def pose(letter: str, n: int) -> Batch:
    draft = Draft()
    if n == 0:
        return draft.se2(f"{letter}0", (0, 0, 0), fixed=True).batch()
    draft.se2(f"{letter}{n}").between_se2(f"{letter}{n - 1}", f"{letter}{n}", (1, 0, 0.1), sigmas=(0.1, 0.1, 0.1))
    return draft.batch()


def drive(end: End, letter: str, first: int, last: int) -> None:
    for n in range(first, last):
        assert isinstance(end.insert(f"robot-{letter}", pose(letter, n)), Accepted)


def bits(end: End) -> dict[int, bytes]:
    found: dict[int, bytes] = {}
    for group in end.solver.solver.estimate():
        found |= dict(zip(group.keys.tolist(), (row.tobytes() for row in group.values), strict=True))
    return found


def test_what_is_pushed_gives_the_same_bits_and_is_taken_once(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(robot, "x", 0, 12)
    done = robot.push_to(base, JournalPlace())
    assert base.place() == robot.place() == JournalPlace(done.last.record, done.last.chain)
    assert bits(base) == bits(robot)
    assert len(base.deltas) == 12, "who follows the upstream sees every step"
    with pytest.raises(Problem) as again:
        robot.push_to(base, JournalPlace())
    assert again.value.code == "records_moved_on"
    assert base.insert("robot-x", pose("x", 11), number=12).sequence == 12, "it has the answer, as to its own"
    robot.follow(base, JournalPlace())
    assert robot.place() == base.place()
    assert robot.keeper().upstream == base.place()


def test_what_others_wrote_comes_first_and_what_is_here_alone_behind_it(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(robot, "x", 0, 6)
    robot.push_to(base, JournalPlace())
    same = base.place()
    drive(base, "y", 0, 4)
    drive(robot, "x", 6, 9)
    before = robot.deltas[-1].revision
    done = robot.follow(base, same)
    assert (done.rebased, done.behind, done.refused) == (3, 3, ())
    assert done.same_bits
    delta = robot.deltas[-1]
    assert (delta.previous, delta.report["rebased"]) == (0, 3)
    assert delta.revision > before
    assert sum(len(group.keys) for group in delta.variables) == 13, "it has the whole estimate"
    robot.push_to(base, base.place())
    assert robot.place() == base.place()
    assert bits(robot) == bits(base)
    assert [e.client for r in robot.records() for e in r.entries] == ["robot-x"] * 6 + ["robot-y"] * 4 + ["robot-x"] * 3
    drive(robot, "x", 9, 11)
    assert robot.deltas[-1].previous == robot.deltas[-2].revision


def test_what_upstream_cannot_take_is_told_and_goes_here_too(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(base, "x", 0, 3)
    drive(robot, "x", 0, 1)
    assert isinstance(robot.insert("robot-x", Draft().se2("x1", (5, 5, 0), fixed=True).batch()), Accepted)
    assert isinstance(robot.insert("tablet-1", Draft().se2("x2", (7, 7, 0), fixed=True).batch()), Accepted)
    before = robot.deltas[-1].revision
    done = robot.follow(base, JournalPlace())
    codes = {(told.client, told.sequence): told.answer.code for told in done.refused}
    assert codes == {("robot-x", 2): "number_taken", ("tablet-1", 1): "duplicate_variable"}
    assert robot.deltas[-1].revision > before, "who follows the map sees it, though there is less in it"
    again = robot.insert("tablet-1", Draft().se2("x2", (7, 7, 0), fixed=True).batch(), number=1)
    assert again.code == "duplicate_variable", "it is what the number is answered from now on"
    robot.push_to(base, base.place())
    assert robot.place() == base.place()
    assert bits(robot) == bits(base)


def test_a_change_of_factors_that_have_other_ids_now_is_refused(ends: Callable[[str], End]) -> None:
    robot, base = ends("robot"), ends("base")
    drive(robot, "x", 0, 4)
    robot.push_to(base, JournalPlace())
    same = base.place()
    drive(base, "y", 0, 3)
    loop = Draft().between_se2("x0", "x3", (3, 0, 0.3), sigmas=(0.1, 0.1, 0.1)).batch()
    first = robot.insert("robot-x", loop).first_factor
    removal = Change("remove_factors", factors=np.array([first]))
    assert isinstance(robot.insert("robot-x", Batch(), (removal,)), Accepted)
    done = robot.follow(base, same)
    assert [told.answer.code for told in done.refused] == ["factors_moved"]
    assert robot.solver.size[1] == 3 + 2 + 1, "no factor of another has gone"


def test_a_refusal_stays_a_refusal(ends: Callable[[str], End]) -> None:
    """Here the variable was not there; upstream it is.  Who was refused was told so, and that is final."""
    robot, base = ends("robot"), ends("base")
    drive(base, "y", 0, 3)
    drive(robot, "x", 0, 2)
    seen = Draft().between_se2("x1", "y2", (1, 0, 0), sigmas=(0.1, 0.1, 0.1)).batch()
    assert robot.insert("robot-x", seen).code == "unknown_variable"
    robot.follow(base, JournalPlace())
    assert robot.solver.size[1] == 2 + 1
    outcomes = [entry.outcome for record in robot.records() for entry in record.entries]
    assert outcomes.count(ACCEPTED) == len(outcomes) - 1


def test_a_disk_that_takes_nothing_leaves_all_as_it_was(
    ends: Callable[[str], End], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, base = ends("robot"), ends("base")
    drive(base, "y", 0, 3)
    drive(robot, "x", 0, 3)
    before, had = robot.place(), bits(robot)

    def full(*_: Any) -> None:
        raise JournalFailed(robot.folder, "no room")

    with monkeypatch.context() as patched:
        patched.setattr("factorbus.service.journal.keeping.rewrite", full)
        with pytest.raises(Problem) as raised:
            robot.follow(base, JournalPlace())
    assert raised.value.code == "journal_failed"
    assert (robot.place(), bits(robot)) == (before, had)
    robot.follow(base, JournalPlace())
    robot.push_to(base, base.place())
    assert bits(robot) == bits(base)
    drive(robot, "x", 3, 5)


def test_what_was_rebased_comes_back_after_a_restart(tmp_path: Path) -> None:
    robot, base = End(tmp_path / "robot"), End(tmp_path / "base")
    drive(robot, "x", 0, 4)
    drive(base, "y", 0, 4)
    robot.follow(base, JournalPlace())
    place, had = robot.place(), bits(robot)
    robot.close()
    robot = End(tmp_path / "robot")
    assert (robot.place(), bits(robot)) == (place, had)
    assert robot.insert("robot-x", pose("x", 3), number=4).sequence == 4
    robot.push_to(base, base.place())
    assert bits(robot) == bits(base)
    robot.close()
    base.close()
