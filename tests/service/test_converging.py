"""A map that is left alone before it has converged goes on by itself: the core alone, told of solver and time."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Insert
from factorbus.proto.problems import Internal
from factorbus.service.config import Limits
from factorbus.service.core import converging
from factorbus.service.core.events import (
    Applied,
    Arrived,
    ArrivedQuestion,
    Drained,
    Effect,
    InsertBatch,
    Outcome,
    ParsedInsert,
    Publish,
    SingleInsertResult,
    Stepped,
    Verdict,
)
from factorbus.service.core.map_state import MapCore, Restored
from factorbus.service.questions.admin import MovedOn

LATER = converging.CONVERGE_IDLE_S


class Driven:
    """A core with a clock that stands unless it is moved, and a solver that says what it is told to say."""

    def __init__(self) -> None:
        self.core = MapCore("m", "auto", 5, Limits(), now=0.0)
        self.now, self.cpu_s, self.sequence, self.revision, self.chi2 = 0.0, 0.0, 0, 0, 1e6

    def insert(self, converged: bool, **of_step: Any) -> None:
        """One is inserted, and its step ends so."""
        self.done(the_run(self.core.insert(self.arrived())), converged, **of_step)

    def arrived(self) -> Arrived:
        self.sequence += 1
        content = Insert(self.sequence, Batch())
        return Arrived([f"a{self.sequence}"], "a", self.sequence, 0, 10, self.sequence, content, self.now)

    def tick(self, later: float = LATER) -> list[Effect]:
        self.now += later
        return self.core.tick(self.now)

    def done(self, run: InsertBatch, converged: bool, took_s: float = 0.0, **of_step: Any) -> list[Effect]:
        """What comes of `run`; each step halves χ², unless it is told another."""
        self.now += took_s
        self.cpu_s += took_s
        self.revision += 1
        self.chi2 = of_step.pop("chi2", self.chi2 / 2)
        effects = self.core.give_verdict(Verdict(tuple(Outcome(i, b"ok") for i in run.inserts))) if run.inserts else []
        of_step = {"changed": 3, **of_step}
        effects += self.core.stepped(
            Stepped(self.revision, b"", "tree", self.chi2, 1.0, converged=converged, further=run.further, **of_step)
        )
        return effects + self.core.applied(Applied(3, 4, self.cpu_s, self.now))

    def says(self) -> tuple[bool, bool, bool]:
        """Converged, converging, and whether it has given up."""
        stats = self.core.stats(self.now)
        assert {name: stats[name] for name in ("converged", "converging")} == {
            name: self.core.row()[name] for name in ("converged", "converging")
        }
        return stats["converged"], stats["converging"], bool(stats["gave_up"])


CONVERGED, CONVERGING, GAVE_UP = (True, False, False), (False, True, False), (False, False, True)
POLISHED = (True, True, False)


@pytest.fixture
def driven() -> Driven:
    return Driven()


def the_run(effects: list[Effect]) -> InsertBatch:
    (run,) = [effect for effect in effects if isinstance(effect, InsertBatch)]
    assert effects[-1] is run
    return run


def goes_on(effects: list[Effect]) -> bool:
    runs = [effect for effect in effects if isinstance(effect, InsertBatch)]
    assert all(run.further and not run.inserts and not run.short for run in runs)
    return bool(runs)


def chain(driven: Driven, of_step: Callable[[int], dict[str, Any]], most: int = 20_000) -> int:
    """How many further steps there are when the n-th ends as `of_step` says; ticks never hurry."""
    effects = driven.tick()
    for n in range(most):
        if not goes_on(effects):
            return n
        how = of_step(n)
        effects = driven.done(the_run(effects), how.pop("converged", False), **how)
        effects = effects if goes_on(effects) else driven.tick(60.0)
    raise AssertionError(f"it has no end in {most} steps")


def test_a_map_that_has_converged_is_left_alone(driven: Driven) -> None:
    assert driven.says() == CONVERGED
    driven.insert(converged=True)
    assert [driven.tick() for _ in range(3)] == [[], [], []]
    assert driven.says() == CONVERGED


def test_one_that_is_not_at_its_optimum_is_polished_when_it_is_left_alone_for_longer(driven: Driven) -> None:
    driven.insert(converged=True, unfinished=True)
    assert driven.says() == POLISHED
    assert driven.tick(0.9 * converging.POLISH_IDLE_S) == []
    effects = driven.done(the_run(driven.tick()), converged=True, unfinished=True)
    assert driven.says() == POLISHED
    run = the_run(effects + driven.tick())
    waiting = driven.arrived()
    assert driven.core.insert(waiting) == []
    following = the_run(driven.done(run, converged=True, unfinished=True))
    assert (following.inserts, following.further) == ((waiting,), False), "an insert comes first"
    assert not goes_on(driven.done(following, converged=True, unfinished=True))
    assert driven.tick(0.9 * converging.POLISH_IDLE_S) == [], "and after it the whole time is waited for again"
    effects = driven.done(the_run(driven.tick()), converged=True)
    assert not goes_on(effects + driven.tick(60.0)), "nothing at all when it is finished"
    assert driven.says() == CONVERGED
    assert driven.core.stats(driven.now)["further_steps"] == 1


def test_a_drive_is_not_polished(driven: Driven) -> None:
    """One insert after the other: nothing comes in between."""
    for _ in range(5):
        driven.insert(converged=True, unfinished=True)
        assert driven.tick(0.9 * converging.POLISH_IDLE_S) == []


def test_one_that_converges_by_itself_is_polished_at_once(driven: Driven) -> None:
    driven.insert(converged=False, unfinished=True)
    ends = [(False, True), (True, True), (True, False)]
    effects = driven.tick()
    for converged, unfinished in ends:
        effects = driven.done(the_run(effects), converged=converged, unfinished=unfinished)
    assert not goes_on(effects + driven.tick(60.0))


@pytest.mark.parametrize("of_step", [{"changed": 0}, {"chi2": 7.0}])
def test_one_that_cannot_finish_does_not_try_for_ever(driven: Driven, of_step: dict[str, Any]) -> None:
    driven.insert(converged=True, unfinished=True)
    driven.now += converging.POLISH_IDLE_S
    count = chain(driven, lambda _: {"converged": True, "unfinished": True, **of_step})
    assert 1 <= count <= 21
    assert driven.says() == (True, False, True)
    assert not any(goes_on(driven.tick(60.0)) for _ in range(10))


def test_one_that_has_not_goes_on_until_it_has(driven: Driven) -> None:
    driven.insert(converged=False)
    assert driven.says() == CONVERGING
    effects = driven.tick()
    for n in range(4):
        run = the_run(effects)
        assert (run.further, run.inserts) == (True, ())
        effects = driven.done(run, converged=n == 3)
        assert [type(effect) for effect in effects][:1] == [Publish]
    assert not goes_on(effects + driven.tick())
    assert driven.says() == CONVERGED
    assert driven.core.stats(driven.now)["further_steps"] == 4
    assert driven.core.revision == 5


def test_it_goes_on_only_when_no_insert_came_for_a_moment(driven: Driven) -> None:
    driven.insert(converged=False)
    assert not goes_on(driven.tick(LATER / 2))
    driven.insert(converged=False)
    assert not goes_on(driven.tick(LATER * 0.9)), "quiet since the last insert"
    assert goes_on(driven.tick(LATER * 0.2))


def test_after_one_that_is_done_at_once_quiet_is_waited_for_too(driven: Driven) -> None:
    """The short way: on the thread that brings the insert."""
    driven.insert(converged=False)
    effects = driven.done(the_run(driven.tick()), converged=False)
    driven.done(the_run(effects), converged=True)
    driven.now += 1.0
    insert = driven.arrived()._replace(content=ParsedInsert(b"", np.zeros((0, 0), np.int64), False))
    run = the_run(driven.core.insert(insert))
    assert run.short
    stepped = Stepped(4, b"", "tree", 9.0, 1.0, converged=False)
    alone = SingleInsertResult(Outcome(insert, b"ok", 0), stepped, Applied(3, 4, 0.0, driven.now))
    assert not goes_on(driven.core.alone(alone, insert.askers[0]))
    assert driven.says() == CONVERGING
    assert not goes_on(driven.tick(LATER / 2))
    assert goes_on(driven.tick(LATER / 2 + 1e-6))


def test_who_inserts_waits_for_no_more_than_one_step_and_comes_first(driven: Driven) -> None:
    driven.insert(converged=False)
    run = the_run(driven.tick())
    waiting = driven.arrived()
    assert driven.core.insert(waiting) == [], "the solver is at it"
    following = the_run(driven.done(run, converged=False))
    assert (following.inserts, following.further) == ((waiting,), False)
    assert not goes_on(driven.done(following, converged=False)), "and after it quiet is waited for again"
    assert goes_on(driven.tick())


def test_questions_are_answered_of_the_latest_revision_and_do_not_stop_it(driven: Driven) -> None:
    driven.insert(converged=False)
    run = the_run(driven.tick())
    assert driven.core.ask(ArrivedQuestion("q", "chi2", b""), driven.now) == []
    following = the_run(driven.done(run, converged=False))
    assert [read.asker for read in following.reads] == ["q"]
    assert following.further, "reads come first in an InsertBatch, and so are of the step before"
    driven.done(following, converged=False)
    for n in range(20):  # who asks all the time
        effects = driven.core.ask(ArrivedQuestion(f"q{n}", "chi2", b""), driven.now)
        if not effects:
            break
        driven.core.applied(Applied(3, 4, 0.0, driven.now))
    assert driven.core.stats(driven.now)["further_steps"] >= 2


def test_steps_that_change_nothing_end_it_soon(driven: Driven) -> None:
    driven.insert(converged=False)
    assert chain(driven, lambda n: {"changed": 0, "chi2": 7.0}) == 3
    assert driven.says() == GAVE_UP
    assert "changed nothing" in driven.core.stats(driven.now)["gave_up"]
    assert not any(goes_on(driven.tick(60.0)) for _ in range(10)), "for ever, as long as nobody inserts"
    driven.insert(converged=False)
    assert driven.says() == CONVERGING
    assert goes_on(driven.tick()), "what is new may help"


def test_with_damping_left_the_next_step_tries_another_way(driven: Driven) -> None:
    driven.insert(converged=False)
    ladder = [10.0**n for n in range(-5, 12)]

    def step(n: int) -> dict[str, Any]:
        if n < len(ladder):
            return {"changed": 0, "damping": ladder[n], "chi2": 7.0}
        return {"converged": True, "chi2": 6.0}

    assert chain(driven, step) == len(ladder) + 1
    assert driven.says() == CONVERGED


def test_steps_that_move_to_and_fro_end_it(driven: Driven) -> None:
    driven.insert(converged=False)
    assert chain(driven, lambda n: {"chi2": 7.0 + 1e-9 * (n % 2)}) == 21, "the first one was of use"
    assert driven.says() == GAVE_UP
    assert "did not lower" in driven.core.stats(driven.now)["gave_up"]


@pytest.mark.parametrize(("took_s", "most"), [(0.0, converging.MOST), (7.0, 43)])
def test_slow_ones_that_lower_it_go_on_and_there_is_an_end_to_them_too(
    driven: Driven, took_s: float, most: int
) -> None:
    """After some steps, or when they took too much of a core: the one step more was begun before that was known."""
    driven.insert(converged=False)
    assert chain(driven, lambda n: {"chi2": 1e3 * (1 - 1e-8 * n), "took_s": took_s}) == most + (took_s > 0)
    assert driven.says() == GAVE_UP


def test_a_solver_that_refuses_is_not_tried_again(driven: Driven) -> None:
    driven.insert(converged=False)
    run = the_run(driven.tick())
    assert not goes_on(driven.core.applied(Applied(3, 4, 0.0, driven.now, refused=True)) + driven.tick())
    assert run.further
    assert driven.says() == GAVE_UP
    driven.insert(converged=True, unfinished=True)
    assert driven.says() == POLISHED, "what is new may help"
    the_run(driven.tick(converging.POLISH_IDLE_S))
    assert not goes_on(driven.core.applied(Applied(3, 4, 0.0, driven.now, refused=True)) + driven.tick(60.0))
    assert driven.says() == (True, False, True)


def test_one_that_diverges_is_not_tried_again_though_undoing_it_is_a_step(driven: Driven) -> None:
    """In whichever order that is told: with durability commit the solver is free before the step is."""
    for free_first in (False, True):
        driven.insert(converged=True, unfinished=True)
        the_run(driven.tick(converging.POLISH_IDLE_S))
        driven.revision += 1
        undone = Stepped(driven.revision, b"", "full", 5.0, 1.0, changed=3, further=True, unfinished=True)
        applied = Applied(3, 4, 0.0, driven.now, refused=True)
        if free_first:
            driven.core.applied(applied)
            driven.core.kept([undone], driven.now)
        else:
            driven.core.stepped(undone)
            driven.core.applied(applied)
        assert not goes_on(driven.tick(60.0))
        assert driven.says() == (True, False, True)


def test_a_solver_that_was_replaced_is_not_tried_again(driven: Driven) -> None:
    driven.insert(converged=False)
    assert chain(driven, lambda n: {"rebuilt": True}) == 1
    assert driven.says() == GAVE_UP


def test_after_a_while_the_solver_rests_for_as_long_as_it_works(driven: Driven) -> None:
    driven.insert(converged=False)
    effects, worked, begun = driven.tick(), 0, driven.now
    while worked < 40:
        if goes_on(effects):
            effects, worked = driven.done(the_run(effects), converged=False, took_s=0.25), worked + 1
        else:
            effects = driven.tick(0.25)
    elapsed = driven.now - begun
    full = converging.FULL_SPEED_S
    assert elapsed == pytest.approx(full + 2 * (40 * 0.25 - full), abs=1.0), "half of the time after the first two"


def test_while_a_step_is_not_written_or_nothing_can_be_there_is_none(driven: Driven) -> None:
    """With a journal, and durability commit: what the solver did is told when it is safe."""
    driven.insert(converged=False)
    run = the_run(driven.tick())
    assert not goes_on(driven.core.applied(Applied(3, 4, 0.0, driven.now)) + driven.tick()), "not told yet"
    told = Stepped(2, b"", "tree", 5.0, 1.0, converged=False, changed=3, further=run.further)
    assert goes_on(driven.core.kept([told], driven.now))
    driven.core.applied(Applied(3, 4, 0.0, driven.now))
    driven.core.unkept(Internal("x"), driven.now)  # that one did not happen
    driven.core.applied(Applied(3, 4, 0.0, driven.now))  # the solver has gone back
    assert not any(goes_on(driven.tick()) for _ in range(3)), "the disk is full"
    assert driven.core.revision == 2
    assert driven.says() == CONVERGING
    driven.core.unblock()
    assert goes_on(driven.tick())


def test_a_map_that_comes_back_goes_on(driven: Driven) -> None:
    driven.core.restore((), Restored(7, 3, 4, 9.0, converged=False))
    assert driven.says() == CONVERGING
    assert goes_on(driven.tick())
    driven.core.restore((), Restored(7, 3, 4, 9.0, unfinished=True))
    assert driven.says() == POLISHED
    driven.core.restore((), Restored(7, 3, 4, 9.0))
    assert driven.says() == CONVERGED


@pytest.mark.parametrize("end", ["stop", "drop"])
def test_a_map_that_goes_takes_no_further_step(driven: Driven, end: str) -> None:
    driven.insert(converged=False)
    run = the_run(driven.tick())
    assert Drained() not in getattr(driven.core, end)(driven.now)
    effects = driven.done(run, converged=False)
    assert effects[-1] == Drained()
    assert driven.tick() == []


def test_further_steps_do_not_keep_a_map_from_being_dropped_at_a_revision(driven: Driven) -> None:
    driven.insert(converged=True)
    driven.insert(converged=False)
    driven.done(the_run(driven.tick()), converged=False)
    assert driven.core.revision == 3
    for revision in (2, 3):
        driven.core.check_at(revision)
    for revision in (1, 4):
        with pytest.raises(MovedOn):
            driven.core.check_at(revision)
