"""One map as a state machine, with no bus, clock, thread or solver."""

from typing import Any

import pytest

from factorbus.proto import codec
from factorbus.proto.messages import Batch, Change, Insert
from factorbus.proto.problems import Internal, UnknownMap
from factorbus.service.config import Limits
from factorbus.service.core.events import (
    Answer,
    Applied,
    Arrived,
    ArrivedQuestion,
    Drained,
    Effect,
    InsertBatch,
    Outcome,
    Publish,
    Refuse,
    Stepped,
    Tell,
    Verdict,
)
from factorbus.service.core.map_state import MapCore


@pytest.fixture
def core() -> MapCore:
    return MapCore("m", "auto", 5, Limits(step_inserts=2, snapshot_steps=3, questions=2), now=0.0)


def insert(client: str, sequence: int) -> Arrived:
    return Arrived([f"{client}{sequence}"], client, sequence, 0, 10, sequence, Insert(sequence, Batch()), 1.0)


def run_of(effects: list[Effect]) -> InsertBatch:
    (run,) = [effect for effect in effects if isinstance(effect, InsertBatch)]
    return run


def events(effects: list[Effect]) -> list[str]:
    return [codec.decode_map(e.message)["event"] for e in effects if isinstance(e, Publish) and e.channel == "event"]


def solved(core: MapCore, run: InsertBatch, answer: Any = b"ok") -> list[Effect]:
    effects = core.give_verdict(Verdict(tuple(Outcome(i, answer) for i in run.inserts)))
    if run.inserts and isinstance(answer, bytes):
        effects += core.stepped(Stepped(core.revision + 1, b"delta", "all-batch", 1.5, 2.0))
    return effects + core.applied(Applied(3, 4, 0.5, 2.0))


def test_an_insert_goes_to_a_free_solver_at_once_and_the_next_ones_wait(core: MapCore) -> None:
    run = run_of(core.insert(insert("a", 1)))
    assert [core.insert(insert("a", s)) for s in (2, 3, 4)] == [[], [], []]
    effects = solved(core, run)
    assert effects[:2] == [Answer("a1", b"ok"), Publish("delta", b"delta")]
    assert [i.sequence for i in run_of(effects).inserts] == [2, 3], "no more than `step_inserts` at a time"
    assert core.revision == 1


def brought(core: MapCore, sequence: int, at: float, size: int = 10, settle: bool = False) -> InsertBatch:
    """The InsertBatch for one more insert, which arrives `at`."""
    message = Insert(sequence, Batch(), settle)
    return run_of(core.insert(Arrived([f"a{sequence}"], "a", sequence, 0, size, sequence, message, at)))


def finish(core: MapCore, run: InsertBatch, at: float) -> list[Effect]:
    core.give_verdict(Verdict(tuple(Outcome(i, b"ok") for i in run.inserts)))
    return core.applied(Applied(3, 4, 0.5, at))


def ran(core: MapCore, sequence: int, begin: float, end: float) -> bool:
    """Was the InsertBatch from `begin` to `end` called short?"""
    run = brought(core, sequence, begin)
    finish(core, run, end)
    return run.short


def test_a_run_is_short_when_those_of_late_were(core: MapCore) -> None:
    short = [ran(core, n, n, n + (0.5 if n == 3 else 0.001)) for n in range(1, 60)]
    assert short[:3] == [False, True, True], "nothing is known of the first"
    assert not any(short[3:55]), "one slow InsertBatch is remembered: 0.9^52 of half a second is just above 2 ms"
    assert all(short[56:])


def test_a_run_is_not_short_for_an_insert_that_was_on_its_way_already(core: MapCore) -> None:
    assert [ran(core, 1, 1.0, 1.001), ran(core, 2, 1.0011, 1.002), ran(core, 3, 1.0025, 1.003)] == [False, False, True]


def test_a_run_is_not_short_when_it_is_large_settles_reads_or_follows_another(core: MapCore) -> None:
    assert not ran(core, 1, 1.0, 1.001)
    run = brought(core, 2, 2.0, size=1 << 20)
    assert not run.short
    finish(core, run, 2.001)
    run = brought(core, 3, 3.0, settle=True)
    assert not run.short
    finish(core, run, 3.001)
    asked = run_of(core.ask(ArrivedQuestion("q", "estimate", b""), 4.0))
    assert not asked.short
    core.insert(insert("a", 4))
    assert not run_of(finish(core, asked, 4.001)).short, "that one came in meanwhile, and so may others"


def test_a_refusal_is_answered_and_counted(core: MapCore) -> None:
    problem = UnknownMap("x")
    run = run_of(core.insert(insert("a", 1)))
    assert solved(core, run, problem) == [Refuse("a1", problem, 2)]
    assert core.revision == 0
    assert core.stats(3.0)["inserts"] == {"accepted": 0, "refused": 1, "busy": 0}


def test_questions_are_answered_between_two_steps(core: MapCore) -> None:
    run = run_of(core.insert(insert("a", 1)))
    assert core.ask(ArrivedQuestion("q", "estimate", b""), 1.0) == []
    core.insert(insert("a", 2))
    following = run_of(solved(core, run))
    assert [read.asker for read in following.reads] == ["q"]
    assert [i.sequence for i in following.inserts] == [2]


def test_stats_do_not_wait_for_the_solver(core: MapCore) -> None:
    core.insert(insert("a", 1))
    core.insert(insert("a", 2))
    (tell,) = core.ask(ArrivedQuestion("q", "stats", b""), 4.0)
    assert isinstance(tell, Tell)
    assert tell.asker == "q"
    assert {k: tell.content[k] for k in ("name", "epoch", "waiting", "in_solver", "clients", "uptime_s")} == {
        "name": "m",
        "epoch": 5,
        "waiting": 1,
        "in_solver": 1,
        "clients": {"a": 3},
        "uptime_s": 4.0,
    }


@pytest.mark.parametrize(
    ("question", "payload", "code"),
    [
        ("weather", b"", "unknown_question"),
        ("estimate", b"\xc1", "bad_message"),
        ("estimate", codec.encode_map({"keys": b"1234567"}), "bad_message"),
        ("chi2", codec.encode_map({"batch": 1}), "bad_message"),
        ("chi2", codec.encode_map({"timeout_s": -1}), "bad_option"),
        ("chi2", codec.encode_map({"timeout_s": "1"}), "bad_message"),
        ("export", codec.encode_map({"format": "pdf"}), "bad_option"),
        ("export", codec.encode_map({"format": "tum", "strict": True}), "bad_option"),
        ("export", codec.encode_map({"format": "kitti", "ids": "keys"}), "bad_option"),
        ("export", codec.encode_map({"format": "pyfg", "ids": "keys"}), "bad_option"),
        ("export", codec.encode_map({"format": "jrl", "robot": "a"}), "bad_option"),
        ("graph", b"\x93\x01\x02\x03", "bad_message"),
    ],
)
def test_a_question_that_cannot_be_answered_is_refused(core: MapCore, question: str, payload: bytes, code: str) -> None:
    (effect,) = core.ask(ArrivedQuestion("q", question, payload), 1.0)
    assert isinstance(effect, Refuse)
    assert effect.problem.code == code


def test_questions_are_bounded(core: MapCore) -> None:
    core.insert(insert("a", 1))
    seen = [core.ask(ArrivedQuestion(n, "estimate", b""), 1.0) for n in range(3)]
    assert seen[:2] == [[], []]
    (effect,) = seen[2]
    assert isinstance(effect, Refuse)
    assert effect.problem.code == "busy"


@pytest.mark.parametrize("limits", [Limits(snapshot_steps=3), Limits(snapshot_bytes=15)])
def test_a_snapshot_now_and_then(limits: Limits) -> None:
    core = MapCore("m", "auto", 5, limits, now=0.0)
    due = 3  # the third step, or the third delta of five bytes
    for sequence in range(1, due + 1):
        effects = solved(core, run_of(core.insert(insert("a", sequence))))
        snapshots = [r.question.name for e in effects if isinstance(e, InsertBatch) for r in e.reads]
        assert snapshots == (["snapshot"] if sequence == due else [])


def test_stopping_answers_everything_accepted_and_takes_nothing_new(core: MapCore) -> None:
    run = run_of(core.insert(insert("a", 1)))
    core.insert(insert("a", 2))
    core.insert(insert("a", 9))
    stopping = core.stop(2.0)
    assert events(stopping) == ["stopping"]
    assert [(e.asker, e.problem.code) for e in stopping if isinstance(e, Refuse)] == [("a9", "shutting_down")]
    (refused,) = core.insert(insert("a", 3))
    assert isinstance(refused, Refuse)
    assert refused.problem.code == "shutting_down"
    effects = solved(core, run)
    assert Drained() not in effects
    effects = solved(core, run_of(effects))
    assert [e.asker for e in effects if isinstance(e, Answer)] == ["a2"]
    assert effects[-1] == Drained()
    assert core.ask(ArrivedQuestion("q", "stats", b""), 3.0)[0].problem.code == "shutting_down"  # type: ignore[union-attr]


def test_stopping_when_nothing_waits_is_done_at_once(core: MapCore) -> None:
    assert core.stop(1.0)[-1] == Drained()
    assert Drained() not in core.insert(insert("a", 1)), "drained once"


def test_dropping_refuses_what_waits_but_not_what_is_being_solved(core: MapCore) -> None:
    run = run_of(core.insert(insert("a", 1)))
    core.insert(insert("a", 2))
    core.ask(ArrivedQuestion("q", "estimate", b""), 1.0)
    dropping = core.drop(2.0)
    assert sorted((e.asker, e.problem.code) for e in dropping if isinstance(e, Refuse)) == [
        ("a2", "unknown_map"),
        ("q", "unknown_map"),
    ]
    assert events(dropping) == ["dropped"]
    effects = solved(core, run)
    assert effects == [Answer("a1", b"ok"), Publish("delta", b"delta"), Drained()]


def test_when_the_thread_of_a_map_fails_nobody_is_left_waiting(core: MapCore) -> None:
    core.insert(insert("a", 1))
    core.insert(insert("a", 2))
    core.insert(insert("b", 2))
    core.ask(ArrivedQuestion("q", "estimate", b""), 1.0)
    effects = core.failed(Internal("0123"), 2.0)
    told = [(e.asker, e.problem.code) for e in effects if isinstance(e, Refuse)]
    assert sorted(told) == [("a1", "internal"), ("a2", "internal"), ("b2", "internal"), ("q", "internal")]
    assert effects[-1] == Drained()
    for later in (core.insert(insert("a", 3)), core.ask(ArrivedQuestion("q", "stats", b""), 3.0)):
        assert [e.problem.code for e in later if isinstance(e, Refuse)] == ["internal"]


def test_a_gap_ends_with_time(core: MapCore) -> None:
    core.insert(insert("a", 2))
    assert core.tick(3.0) == []
    (effect,) = core.tick(60.0)
    assert isinstance(effect, Refuse)
    assert effect.problem.code == "bad_sequence"


def test_an_insert_waits_for_no_more_than_the_change_under_way() -> None:
    core = MapCore("m", "auto", 5, Limits(), now=0.0)
    changes = [insert("a", n)._replace(content=Insert(n, Batch(), changes=(Change("weigh"),))) for n in range(1, 11)]
    run = run_of(core.insert(changes[0]))
    for change in changes[1:]:
        core.insert(change)
    for n in (1, 2, 3):
        assert [i.client for i in run.inserts] == ["a"]
        assert not run.short
        core.insert(insert("b", n))
        run = run_of(solved(core, run))
        assert [f"{i.client}{i.sequence}" for i in run.inserts] == [f"b{n}"]
        run = run_of(solved(core, run))
