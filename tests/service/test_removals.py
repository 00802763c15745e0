"""When a map takes out poses that it has enough of: the core alone, told of solver and time."""

from typing import Any

import pytest

from factorbus.proto import codec
from factorbus.proto.keep import keep_text
from factorbus.proto.messages import Batch, Insert
from factorbus.proto.own_clients import KEEPER
from factorbus.proto.problems import Internal
from factorbus.service.config import Limits
from factorbus.service.core import converging, removals
from factorbus.service.core.events import Applied, Arrived, Effect, InsertBatch, Outcome, Publish, Stepped, Verdict
from factorbus.service.core.map_state import MapCore
from factorbus.service.core.removals import IdleRemovals, Planned

POLICY = keep_text("per_area=2")
IDLE = removals.KEEP_IDLE_S


class Driven:
    """A core whose clock stands unless it is moved, and a solver that says what a test has it say."""

    def __init__(self, keep: str = POLICY, here: bool = True) -> None:
        self.core = MapCore("m", "auto", 5, Limits(), now=0.0, removals=IdleRemovals(keep, here))
        self.now, self.sequence, self.revision = 0.0, 0, 0

    def insert(self) -> None:
        """One, and its step."""
        run = the_run(self.core.insert(self.arrived()))
        assert not run.keep
        self.stepped(run.inserts)
        assert not looks(self.core.applied(self.applied()))

    def arrived(self) -> Arrived:
        self.sequence += 1
        content = Insert(self.sequence, Batch())
        return Arrived([f"a{self.sequence}"], "a", self.sequence, 0, 10, self.sequence, content, self.now)

    def stepped(self, inserts: tuple[Arrived, ...], answer: Any = b"ok", converged: bool = True) -> list[Effect]:
        self.revision += 1
        effects = self.core.give_verdict(Verdict(tuple(Outcome(each, answer) for each in inserts), self.revision))
        return effects + self.core.stepped(Stepped(self.revision, b"", "batch", 1.0, 1.0, converged=converged))

    def applied(self) -> Applied:
        return Applied(3, 4, 0.0, self.now)

    def tick(self, later: float = IDLE) -> list[Effect]:
        self.now += later
        return self.core.tick(self.now)

    def looked(self, planned: Planned, answer: Any = b"ok") -> tuple[list[Effect], list[Effect]]:
        """What the solver found and did, what goes out, and what is done next."""
        self.core.removals.planned(planned)
        own = Arrived([], KEEPER, self.revision + 1, 0, 10, 1, Insert(1, Batch()), 0.0)
        told = self.stepped((own,), answer) if planned.poses else []
        return told, self.core.applied(self.applied())


def the_run(effects: list[Effect]) -> InsertBatch:
    (run,) = [effect for effect in effects if isinstance(effect, InsertBatch)]
    assert effects[-1] is run
    return run


def looks(effects: list[Effect]) -> bool:
    runs = [effect for effect in effects if isinstance(effect, InsertBatch)]
    assert all(not run.inserts and not run.short and not run.further for run in runs if run.keep)
    return any(run.keep for run in runs)


@pytest.fixture
def driven() -> Driven:
    return Driven()


def test_it_looks_when_it_was_idle_for_a_while(driven: Driven) -> None:
    driven.insert()
    assert not looks(driven.tick(IDLE / 2))
    assert looks(driven.tick(IDLE / 2))


@pytest.mark.parametrize("core", [Driven("all"), Driven(here=False)], ids=["keeps all", "replica"])
def test_others_never_look(core: Driven) -> None:
    core.insert()
    assert not looks(core.tick(1e6))


def test_it_goes_on_at_once_as_long_as_something_goes(driven: Driven) -> None:
    driven.insert()
    assert looks(driven.tick())
    for _ in range(3):
        told, then = driven.looked(Planned(64, 3.0))
        assert looks(then)
        (event,) = [each for each in told if isinstance(each, Publish) and each.channel == "event"]
        assert codec.decode_map(event.message)["event"] == "kept"
        assert codec.decode_map(event.message)["poses"] == 64
    told, then = driven.looked(Planned(0, left=2))
    assert not looks(then)
    assert not looks(driven.tick(1e6)), "nothing has changed since"
    kept = driven.core.stats(driven.now)["kept"]
    assert kept == {
        "removed_poses": 192,
        "loss": 9.0,
        "largest_loss": 3.0 / 64,
        "left": 2,
        "pending": False,
        "failed": False,
    }
    driven.insert()
    assert looks(driven.tick())


def test_inserts_go_first_and_make_it_wait_again(driven: Driven) -> None:
    driven.insert()
    assert looks(driven.tick())
    waiting = driven.core.insert(driven.arrived())
    assert not any(isinstance(effect, InsertBatch) for effect in waiting)
    _, then = driven.looked(Planned(64, 3.0))
    run = the_run(then)
    assert run.inserts
    assert not run.keep
    driven.stepped(run.inserts)
    assert looks(driven.core.applied(driven.applied())), "it found something before, so it goes on"


def test_a_map_that_is_never_idle_looks_after_some_steps(driven: Driven) -> None:
    for _ in range(removals.KEEP_STEPS - 1):
        driven.insert()
    run = the_run(driven.core.insert(driven.arrived()))
    driven.stepped(run.inserts)
    assert looks(driven.core.applied(driven.applied()))
    _, then = driven.looked(Planned(0))
    assert not looks(then)
    driven.insert()
    assert not looks(driven.tick(IDLE / 2))


def test_further_steps_come_before(driven: Driven) -> None:
    run = the_run(driven.core.insert(driven.arrived()))
    driven.stepped(run.inserts, converged=False)
    driven.core.applied(driven.applied())
    assert the_run(driven.tick(max(IDLE, converging.CONVERGE_IDLE_S))).further


def test_what_is_refused_is_not_tried_again_until_something_changes(driven: Driven) -> None:
    driven.insert()
    assert looks(driven.tick())
    _, then = driven.looked(Planned(64, 3.0), Internal("it went wrong"))
    assert not looks(then)
    assert not looks(driven.tick(1e6))
    stats = driven.core.stats(driven.now)
    assert stats["kept"]["failed"]
    assert stats["kept"]["removed_poses"] == 0
    driven.insert()
    assert looks(driven.tick())


def test_a_plan_that_fails_is_not_made_again_until_something_changes(driven: Driven) -> None:
    driven.insert()
    assert looks(driven.tick())
    driven.looked(Planned(0, failed=True))
    assert not looks(driven.tick(1e6))


def test_its_own_inserts_are_no_clients(driven: Driven) -> None:
    driven.insert()
    driven.tick()
    driven.looked(Planned(64, 3.0))
    stats = driven.core.stats(driven.now)
    assert list(stats["clients"]) == ["a"]
    assert stats["inserts"]["accepted"] == 1
    assert stats["keep"] == POLICY


def test_nothing_is_looked_for_while_the_journal_cannot_be_written_or_the_map_closes(driven: Driven) -> None:
    driven.insert()
    driven.core.block(Internal("no room"), driven.now)
    assert not looks(driven.tick())
    driven.core.unblock()
    assert looks(driven.tick())
    other = Driven()
    other.insert()
    other.core.stop(other.now)
    assert not looks(other.tick())


def test_what_was_not_kept_is_found_again(driven: Driven) -> None:
    driven.insert()
    assert looks(driven.tick())
    driven.core.removals.planned(Planned(64, 3.0))
    driven.core.unkept(Internal("no room"), driven.now)
    driven.core.unblock()
    run = the_run(driven.core.applied(driven.applied()))
    assert run.reload
    assert driven.core.stats(driven.now)["kept"]["removed_poses"] == 0
