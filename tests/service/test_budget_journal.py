"""Steps with a budget in a journal: run again they have the same bits, from any record, and where others follow it."""

import sqlite3
from collections.abc import Sequence
from pathlib import Path

import pytest

from factorbus.journal.connecting import FORM, FORM_WITH_BUDGETS
from factorbus.journal.problems import JournalOption
from factorbus.journal.records import Epoch
from factorbus.journal.store import NAME, Store, create, open_store
from factorbus.proto import codec
from factorbus.proto.messages import Batch, Insert
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Stepped
from factorbus.service.journal.grafting import sent_records
from factorbus.service.journal.library import make_map_solver
from factorbus.service.journal.recovery import recover, verify
from factorbus.service.journal.writing import written
from factorbus.service.questions.answers import Question
from factorbus.service.solving.apply import MapSolver
from factorbus.service.solving.arrival import message_digest
from factorbus.simulate import manhattan

EPOCH, TIGHT = 7, 3e6
BATCHES = [step.batch for step in manhattan(260, 3)]


def arrived(number: int, batch: Batch) -> Arrived:
    content = Insert(number, batch)
    message = codec.encode_insert(content)
    return Arrived([], "a", number, 0, len(message), message_digest(message), content, 0.0, message)


class Kept:
    """A map with a journal, which steps within budgets."""

    def __init__(self, folder: Path, budget_ms: float = 0.03) -> None:
        self.map_solver = make_map_solver("bayes-tree", {"budget_ms": budget_ms}, EPOCH, Limits())
        self.store: Store = create(folder, "m", "bayes-tree", self.map_solver.options(), EPOCH, "none")

    def apply(self, taken: Sequence[Arrived], budget: float, further: bool = False) -> list[Stepped]:
        self.map_solver.allow(budget)
        events, _ = self.map_solver.apply_whole(taken, further)
        last = self.store.last()
        self.store.append([written(last.record + 1, taken, events, last, further, budget)])
        return [event for event in events if isinstance(event, Stepped)]

    def drive(self) -> int:
        """Tight budgets, others, none, and further steps in between; gives how many left something."""
        left = 0
        for n, batch in enumerate(BATCHES):
            budget = 0.0 if n % 37 == 36 else TIGHT * (1 + n % 3)
            (stepped,) = self.apply([arrived(n + 1, batch)], budget)
            left += stepped.use is not None and not stepped.use.complete
            if n % 23 == 22:
                (stepped,) = self.apply([], TIGHT, further=True)
                left += stepped.use is not None and not stepped.use.complete
        return left


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    made = Kept(tmp_path_factory.mktemp("budget") / "m")
    assert made.drive() > 10
    return made


def values(map_solver: MapSolver) -> dict[int, bytes]:
    taken = map_solver.snapshot([Question("estimate")])
    groups = [(g.keys, g.values) for g in taken.variables if g.values is not None]
    return {int(key): row.tobytes() for ids, numbers in groups for key, row in zip(ids, numbers, strict=True)}


def again() -> MapSolver:
    return make_map_solver("bayes-tree", {"budget_ms": 0.03}, EPOCH, Limits())


def test_run_again_it_has_the_same_bits_at_every_record(kept: Kept) -> None:
    other = again()
    assert all(same for _, same in verify(kept.store, other))
    assert values(other) == values(kept.map_solver)
    found = [record.budget for record in kept.store.records()]
    assert set(found) == {0.0, TIGHT, 2 * TIGHT, 3 * TIGHT}
    assert list(kept.store.check()) == []


def test_other_budgets_would_have_other_bits(kept: Kept, tmp_path: Path) -> None:
    """So what the journal has of them matters, and a changed one is found out."""
    kept.store.copy_to(tmp_path / NAME)
    with sqlite3.connect(tmp_path / NAME) as database:
        database.execute("UPDATE budget SET units = 1e12")
    database.close()
    store = open_store(tmp_path)
    assert not all(same for _, same in verify(store, again()))
    store.close()


def test_the_report_says_what_was_left(kept: Kept) -> None:
    stepped = kept.apply([arrived(len(BATCHES) + 1, next(iter(far())))], TIGHT)[0]
    report = codec.decode_delta(stepped.delta).report
    assert (report["budget"], report["budget_ms"]) == (TIGHT, 0.03)
    assert {"work", "unsolved", "deferred_relinearizations", "complete", "step_ms"} <= set(report)
    assert report["complete"] == kept.map_solver.complete


def far() -> list[Batch]:
    return [Batch((), BATCHES[-1].factors[:1])]


def test_only_a_journal_with_budgets_has_the_form_that_says_so(tmp_path: Path) -> None:
    made = Kept(tmp_path / "m")
    for n, batch in enumerate(BATCHES[:5]):
        made.apply([arrived(n + 1, batch)], 0.0)
    assert form_of(made.store) == FORM
    made.apply([arrived(6, BATCHES[5])], TIGHT)
    assert form_of(made.store) == FORM_WITH_BUDGETS
    assert [record.budget for record in made.store.records()] == [0.0] * 5 + [TIGHT]
    assert [record.budget for record in made.store.records(5)] == [TIGHT]
    made.store.become("other", 4, Epoch(9, 5, "forked"), None)
    made.apply([arrived(5, BATCHES[4])], 0.0)
    made.apply([arrived(6, BATCHES[5])], 2 * TIGHT)
    assert [record.budget for record in made.store.records()] == [0.0] * 5 + [2 * TIGHT]


def form_of(store: Store) -> int:
    with sqlite3.connect(store.path) as database:
        (form,) = database.execute("PRAGMA user_version").fetchone()
    database.close()
    return int(form)


def test_records_that_are_sent_have_their_budgets(kept: Kept) -> None:
    sent, *_ = sent_records(kept.store.records(), frozenset(), 1 << 30, 1 << 30)
    assert [each.budget for each in sent] == [record.budget for record in kept.store.records()]


def test_part_of_the_way_and_then_on(kept: Kept) -> None:
    other, count = again(), kept.store.last().record
    recover(kept.store, other, count // 2)
    state = other.dump()
    third = again()
    third.load(state)
    assert third.complete == other.complete
    for record in kept.store.records(count // 2):
        inserts = [arrived(entry.sequence, codec.decode_insert(entry.message).batch) for entry in record.entries]
        third.allow(record.budget)
        list(third.apply_again(inserts, record.rebuilt, record.further))
    assert values(third) == values(kept.map_solver)


@pytest.mark.parametrize("wrong", [-1.0, float("nan"), float("inf"), 1e9, "10", True, 10])
def test_a_journal_with_a_budget_that_cannot_be_is_refused(wrong: object) -> None:
    with pytest.raises(JournalOption, match="budget_ms"):
        make_map_solver("bayes-tree", {"budget_ms": wrong}, EPOCH, Limits())
