"""A map that is left alone before it is at its optimum: further steps of a real solver, told, kept and made again."""

import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naive.solver_parts import graph_in, has_nothing_new, stepper_in
from turned import closing, optimum
from unconverged import DEGREES, EPOCH, FEW, POSES, arrived, inserts

from factorbus.client import Draft
from factorbus.journal.checkpoints import read_checkpoint, write_checkpoint
from factorbus.journal.problems import JournalDiffers
from factorbus.journal.store import NAME, Store, create, open_store
from factorbus.proto import codec
from factorbus.proto.messages import Delta
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Stepped
from factorbus.service.journal.recovery import recover, verify
from factorbus.service.journal.writing import written
from factorbus.service.questions.answers import Question
from factorbus.service.solving.apply import GOES_ON, MapSolver
from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver
from factorbus.solver.errors import NotFinite
from factorbus.solver.inc_l.steps import IncrementalSteps
from factorbus.solver.kernels.model.bounds import MOST_NUMBER
from factorbus.solver.stepper import Stepper

MODES = ["inc-l", "all-batch"]
ALL_MODES = [*MODES, "inc-l-b10", "bayes-tree"]


def folder_in(mode: str, **options: Any) -> MapSolver:
    settings = Options.of(**{"mode": mode, **FEW, **options})
    return MapSolver(lambda: Solver(settings), EPOCH, Limits(), settings.as_dict())


class Written:
    """A map_solver, and the journal of what it did."""

    def __init__(self, path: Path, mode: str, **options: Any) -> None:
        self.map_solver, self.refused = folder_in(mode, **options), False
        self.store: Store = create(path, path.name, mode, self.map_solver.options(), EPOCH, "none")

    def apply(self, *taken: Arrived, further: bool = False) -> list[Stepped]:
        events, applied = self.map_solver.apply_whole(taken, further)
        self.refused = applied.refused
        last = self.store.last()
        self.store.append([written(last.record + 1, taken, events, last, further)])
        return [event for event in events if isinstance(event, Stepped)]

    def converge(self) -> list[Stepped]:
        steps: list[Stepped] = []
        while self.map_solver.unfinished:
            steps += self.apply(further=True)
            assert not self.refused
            assert len(steps) < 2000
        return steps


def values(map_solver: MapSolver) -> dict[int, bytes]:
    taken = map_solver.snapshot([Question("estimate")])
    return {int(key): row.tobytes() for g in taken.variables for key, row in zip(g.keys, g.values, strict=True)}


def told(deltas: list[Delta]) -> dict[int, bytes]:
    """What a mirror has that was given all of these."""
    have: dict[int, bytes] = {}
    for delta in deltas:
        have |= {int(k): row.tobytes() for g in delta.variables for k, row in zip(g.keys, g.values, strict=True)}
    return have


@pytest.mark.parametrize("mode", MODES)
def test_further_steps_lead_to_the_optimum_and_tell_what_they_change(tmp_path: Path, mode: str) -> None:
    map_, came = Written(tmp_path / "m", mode), inserts()
    deltas = [codec.decode_delta(step.delta) for one in came for step in map_.apply(one)]
    assert not map_.map_solver.converged
    assert (deltas[-1].report["converged"], deltas[-1].report["converging"]) == (False, True)
    before = len(deltas)
    further = map_.converge()
    deltas += [codec.decode_delta(step.delta) for step in further]
    assert len(further) > 2
    assert all(step.further for step in further)
    for delta in deltas[before:]:
        assert (delta.epoch, delta.previous, delta.revision) == (EPOCH, delta.revision - 1, deltas.index(delta) + 1)
        report = delta.report
        assert (report["new_variables"], report["new_factors"]) == (0, 0)
        assert report["because"].startswith(GOES_ON)
        assert report["changed"] == sum(len(group.keys) for group in delta.variables)
    converged = [delta.report["converged"] for delta in deltas[before:]]
    assert converged == sorted(converged)
    assert [delta.report["converging"] for delta in deltas[before:]] == [True] * (len(further) - 1) + [False]
    assert told(deltas) == values(map_.map_solver)
    assert map_.map_solver.chi2() == pytest.approx(optimum(POSES, DEGREES), rel=1e-6)


@pytest.mark.parametrize("mode", ALL_MODES)
def test_a_map_that_has_converged_is_polished_to_its_optimum_and_made_again(tmp_path: Path, mode: str) -> None:
    """With all tries, as a service has it: where a step says `converged` there is up to a thousandth left."""
    map_ = Written(tmp_path / "m", mode, max_iterations=10, max_nonmonotone_steps=20)
    world, judge = WORLDS["manhattan"](120, 7), Solver(Options(mode="all-batch"))
    for n, step in enumerate(world):
        (stepped,) = map_.apply(arrived(n + 1, step.batch))
        report = codec.decode_delta(stepped.delta).report
        assert report["converging"] is stepped.unfinished is map_.map_solver.unfinished
        judge.stage(step.batch)
        judge.step()
    assert map_.map_solver.converged
    assert map_.map_solver.unfinished
    state = map_.map_solver.dump()
    steps = map_.converge()
    assert 1 <= len(steps) <= 3
    assert all(step.converged and step.further for step in steps)
    assert map_.map_solver.chi2() == pytest.approx(judge.step(settle=True).chi2, rel=1e-6)
    again, late = (folder_in(mode, max_iterations=10, max_nonmonotone_steps=20) for _ in range(2))
    assert recover(map_.store, again).same
    late.load(state)
    assert late.unfinished, "a checkpoint knows"
    while late.unfinished:
        late.apply_whole((), further=True)
    assert values(again) == values(map_.map_solver) == values(late)
    assert not again.unfinished
    # Nothing is left to do, also when asked again.
    before = values(map_.map_solver)
    map_.apply(further=True)
    assert values(map_.map_solver) == before


@pytest.mark.parametrize("mode", MODES)
def test_a_journal_has_the_same_bits_again_wherever_it_ends(tmp_path: Path, mode: str) -> None:
    """Further steps between inserts, too: how many there were is in the journal."""
    map_, came = Written(tmp_path / "m", mode), inserts()
    for one in came:
        map_.apply(one)
    for _ in range(3):
        map_.apply(further=True)
    map_.apply(arrived(len(came) + 1, closing(POSES)))
    state, at = map_.map_solver.dump(), map_.store.last()
    for _ in range(2):
        map_.apply(further=True)
    assert not map_.map_solver.converged
    again = folder_in(mode)
    recovered = recover(map_.store, again)
    assert (recovered.same, recovered.last) == (True, map_.store.last())
    assert (values(again), again.revision, again.converged) == (
        values(map_.map_solver),
        map_.map_solver.revision,
        False,
    )
    assert [record.number for record in map_.store.records() if record.further] == [
        len(came) + n for n in (1, 2, 3, 5, 6)
    ]
    write_checkpoint(tmp_path / "s", state)
    late = folder_in(mode)
    late.load(read_checkpoint(tmp_path / "s"))
    assert (late.revision, late.converged) == (at.revision, False)
    map_.converge()
    for other, made in ((again, 2), (late, 0)):
        while other.unfinished:
            other.apply_whole((), further=True)
            made += 1
        assert values(other) == values(map_.map_solver), "what goes on from there goes the same way"
        assert other.revision == map_.map_solver.revision == at.revision + made
    assert all(same for _, same in verify(map_.store, folder_in(mode)))


@pytest.mark.parametrize(
    "damage", ["UPDATE record SET rebuilt = 0 WHERE rebuilt = 2", "DELETE FROM entry WHERE record = 3"]
)
def test_an_insert_that_is_missing_is_not_taken_for_a_further_step(tmp_path: Path, damage: str) -> None:
    map_ = Written(tmp_path / "m", "inc-l")
    for one in inserts():
        map_.apply(one)
    map_.apply(further=True)
    map_.store.close()
    database = sqlite3.connect(tmp_path / "m" / NAME, isolation_level=None)
    database.execute(damage)
    database.close()
    store = open_store(tmp_path / "m")
    with pytest.raises(JournalDiffers, match="led to revision"):
        recover(store, folder_in("inc-l"))
    store.close()


def unconverged(mode: str = "all-batch") -> MapSolver:
    map_solver = folder_in(mode)
    for one in inserts():
        map_solver.apply_whole([one])
    assert not map_solver.converged
    return map_solver


def test_a_further_step_that_is_refused_leaves_all_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    map_solver = unconverged()
    before, revision = values(map_solver), map_solver.revision

    def refuse(solver: Solver, settle: bool = False, budget: float | None = None) -> Any:
        raise NotFinite("χ²")

    monkeypatch.setattr(Solver, "step", refuse)
    events, applied = map_solver.apply_whole((), further=True)
    assert (events, applied.refused, map_solver.revision, values(map_solver)) == ([], True, revision, before)


def test_one_that_is_refused_is_made_again_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It may leave traces in how the next step is made: as that of an insert it is in the journal."""
    map_, true_step = Written(tmp_path / "m", "all-batch"), Solver.step
    for one in inserts():
        map_.apply(one)
    tried: list[Solver] = []

    def refuse(solver: Solver, settle: bool = False, budget: float | None = None) -> Any:
        if has_nothing_new(solver):
            tried.append(solver)
            raise NotFinite("χ²")
        return true_step(solver, settle, budget)

    monkeypatch.setattr(Solver, "step", refuse)
    assert map_.apply(further=True) == []
    assert map_.refused
    *_, last = map_.store.records()
    assert (last.further, last.revision, last.entries) == (True, map_.map_solver.revision, ())
    again = folder_in("all-batch")
    assert recover(map_.store, again).same
    assert len(tried) == 2
    assert (values(again), again.revision) == (values(map_.map_solver), map_.map_solver.revision)


def escaping(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every further step leaves a value beyond what can be kept."""
    true_step, true_changed, escaped = Solver.step, IncrementalSteps.changed, set[Stepper]()

    def step(solver: Solver, settle: bool = False, budget: float | None = None) -> Any:
        further = has_nothing_new(solver)
        report = true_step(solver, settle, budget)
        if further:
            graph_in(solver).values[0] = 2 * MOST_NUMBER
            escaped.add(stepper_in(solver))
        return report

    def changed(stepper: IncrementalSteps) -> np.ndarray:
        return np.arange(stepper.mark[0]) if stepper in escaped else true_changed(stepper)

    monkeypatch.setattr(Solver, "step", step)
    monkeypatch.setattr(IncrementalSteps, "changed", changed)


@pytest.mark.parametrize("sigma", [0.05, 1e-9], ids=["usual numbers", "unusual ones"])
def test_one_that_diverges_is_refused_and_the_map_stays_where_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, sigma: float
) -> None:
    """Where numbers are of unusual sizes it is tried on a copy; else it is undone, in a step of its own."""
    map_ = Written(tmp_path / "m", "all-batch")
    extra = Draft().se2("r0", (0, 0, 0)).between_se2("x0", "r0", (0, 0, 0), sigmas=(sigma, sigma, sigma)).batch()
    for one in (*inserts(), arrived(POSES + 2, extra)):
        map_.apply(one)
    before, revision, solver = values(map_.map_solver), map_.map_solver.revision, map_.map_solver.solver
    chi2 = map_.map_solver.chi2()
    with monkeypatch.context() as patched:
        escaping(patched)
        steps = map_.apply(further=True)
        again = folder_in("all-batch")
        assert recover(map_.store, again).same
    assert map_.refused
    assert [record.levelname for record in caplog.records if "refused" in record.message] == ["WARNING"] * 2
    assert (values(again), again.revision) == (values(map_.map_solver), map_.map_solver.revision)
    if sigma < 1e-8:
        assert (steps, map_.map_solver.revision, map_.map_solver.solver) == ([], revision, solver)
        assert values(map_.map_solver) == before
    else:
        (undone,) = steps
        assert (undone.further, undone.revision, map_.map_solver.revision) == (True, revision + 1, revision + 1)
        assert np.isfinite([np.frombuffer(row) for row in values(map_.map_solver).values()]).all()
        assert map_.map_solver.chi2() <= chi2
    # An insert later it is tried again, and all is well.
    map_.apply(arrived(POSES + 3, closing(POSES)))
    map_.converge()


def failing(*_: Any) -> Any:
    raise ZeroDivisionError


def test_a_solver_that_fails_in_one_is_replaced_and_that_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    map_ = Written(tmp_path / "m", "all-batch")
    for one in inserts():
        map_.apply(one)
    revision, broken = map_.map_solver.revision, map_.map_solver.solver
    monkeypatch.setattr(broken, "step", failing)
    (stepped,) = map_.apply(further=True)
    assert (stepped.rebuilt, stepped.further, stepped.revision) == (True, True, revision + 1)
    assert map_.map_solver.solver is not broken
    assert len(told([codec.decode_delta(stepped.delta)])) == POSES
    again = folder_in("all-batch")
    assert recover(map_.store, again).same
    assert values(again) == values(map_.map_solver)
    assert again.revision == map_.map_solver.revision == revision + 1


def test_one_that_fails_when_it_is_to_tell_what_changed_is_replaced_too(monkeypatch: pytest.MonkeyPatch) -> None:
    map_solver = unconverged()
    revision, broken = map_solver.revision, map_solver.solver
    calls = iter((broken.pick_changed, failing))  # is it sound, and what changed
    monkeypatch.setattr(broken, "pick_changed", lambda: next(calls)())
    (stepped,) = [event for event in map_solver.apply_whole((), further=True)[0] if isinstance(event, Stepped)]
    assert (stepped.rebuilt, stepped.further, stepped.revision) == (True, True, revision + 1)
    assert map_solver.solver is not broken
    assert told([codec.decode_delta(stepped.delta)]) == values(map_solver)
