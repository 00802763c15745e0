"""Which worker gets which job, and what happens when one fails."""

from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from factorbus.proto.messages import Job, JobDone
from factorbus.proto.problems import Refused, Unavailable
from factorbus.service.jobs.dispatch import IN_PLACE, TRIES, Dispatch, Distrusted, Effect, Ended, InPlace, Send

TIMEOUT = Unavailable("worker", 1.0, "")


def job(name: str) -> Job:
    return Job(name, "batch", b"")


def done(name: str) -> JobDone:
    return JobDone(name, "batch", b"result", 0.1)


def places(effects: list[Effect]) -> list[str]:
    return [e.worker if isinstance(e, Send) else IN_PLACE if isinstance(e, InPlace) else "ended" for e in effects]


def tag_of(effects: list[Effect]) -> int:
    (effect,) = effects
    assert isinstance(effect, Send | InPlace)
    return effect.tag


def test_no_worker_means_in_place() -> None:
    dispatch = Dispatch()
    effects = dispatch.submit(job("j"))
    assert places(effects) == [IN_PLACE]
    assert dispatch.done(tag_of(effects), done("j")) == [Ended("j", IN_PLACE, done("j"))]


def test_the_least_busy_worker_first_and_no_more_than_slots() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 2)
    dispatch.joined("b", 1)
    sent = [dispatch.submit(job(f"j{n}")) for n in range(4)]
    assert [places(e) for e in sent] == [["a"], ["b"], ["a"], []]
    assert [row["in_flight"] for row in dispatch.table()] == [2, 1]
    following = dispatch.done(tag_of(sent[1]), done("j1"))
    assert places(following) == ["ended", "b"]


def test_free_is_what_would_be_begun_at_once() -> None:
    dispatch = Dispatch()
    assert dispatch.free("batch") == 0
    dispatch.joined("a", 2)
    dispatch.joined("b", 1)
    free = [dispatch.free("batch")]
    sent = []
    for n in range(4):
        sent.append(dispatch.submit(job(f"j{n}"), ahead=n // 2))
        free.append(dispatch.free("batch"))
    assert free == [3, 2, 1, 0, 0]
    assert [places(effects) for effects in sent] == [["a"], ["b"], ["a"], ["b"]]
    dispatch.done(tag_of(sent[1]), done("j1"))
    assert dispatch.free("batch") == 0, "the one ahead was begun"
    dispatch.done(tag_of(sent[0]), done("j0"))
    assert dispatch.free("batch") == 1


@pytest.mark.parametrize("failure", ["left", "timeout", "internal"])
def test_a_job_whose_worker_fails_goes_to_another_and_then_in_place(failure: str) -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    dispatch.joined("b", 1)
    effects = dispatch.submit(job("j"))
    for wanted in ("b", IN_PLACE):
        (sent,) = effects
        assert isinstance(sent, Send)
        if failure == "left":
            effects = dispatch.left(sent.worker)
        else:
            effects = dispatch.failed(sent.tag, TIMEOUT if failure == "timeout" else Refused("internal", "", {}))
        assert places(effects) == [wanted]
    problem = Refused("internal", "", {})
    assert dispatch.failed(tag_of(effects), problem) == [Ended("j", IN_PLACE, problem)]
    assert dispatch.open_jobs == 0


def test_tries_are_bounded() -> None:
    dispatch = Dispatch()
    for n in range(9):
        dispatch.joined(f"w{n}", 1)
    effects = dispatch.submit(job("j"))
    seen = []
    while places(effects) != [IN_PLACE]:
        seen += places(effects)
        effects = dispatch.failed(tag_of(effects), TIMEOUT)
    assert len(seen) == TRIES


@pytest.mark.parametrize("known", [{"a": 1}, {"a": 1, "b": 1}])
def test_a_refusal_is_believed_only_if_the_service_comes_to_it_too(known: dict[str, int]) -> None:
    dispatch = Dispatch()
    for name, slots in known.items():
        dispatch.joined(name, slots)
    problem = Refused("underconstrained", "x1", {})
    effects = dispatch.failed(tag_of(dispatch.submit(job("j"))), problem)
    assert places(effects) == [IN_PLACE]
    assert dispatch.failed(tag_of(effects), problem) == [Ended("j", IN_PLACE, problem)]
    assert (dispatch.distrusted, dispatch.wrong_answers) == ([], 0)


def test_who_refuses_what_can_be_done_is_distrusted() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    effects = dispatch.failed(tag_of(dispatch.submit(job("j"))), Refused("bad_message", "no map", {}))
    distrusted, ended = dispatch.done(tag_of(effects), done("j"))
    assert ended == Ended("j", IN_PLACE, done("j"), 2)
    assert isinstance(distrusted, Distrusted)
    assert (distrusted.worker, distrusted.times) == ("a", 1)
    assert "refused the job, which can be done: no map [bad_message]" in distrusted.why
    assert places(dispatch.submit(job("k"))) == [IN_PLACE], "it gets nothing for a while"


def test_a_wrong_answer_costs_trust_and_the_job_goes_to_another() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 2)
    dispatch.joined("b", 1)
    first, _, third = (dispatch.submit(job(name)) for name in "jkl")
    assert [places(first), places(third)] == [["a"], ["a"]]
    effects = dispatch.wrong(tag_of(first), "answered nonsense")
    assert effects == [Distrusted("a", "answered nonsense", 1)], "b has no slot: it waits"
    assert (dispatch.distrusted, dispatch.slots("batch"), dispatch.wrong_answers) == (["a"], 1, 1)
    more = dispatch.wrong(tag_of(third), "again")
    assert more == [], "one loss of trust, told once"
    assert dispatch.wrong_answers == 2
    assert dispatch.table()[0] == {"name": "a", "slots": 2, "in_flight": 0, "wrong": 2, "distrusted": True}
    assert places(dispatch.trusted("a")) == [], "it has had both"
    assert places(dispatch.submit(job("m"))) == ["a"]
    again = dispatch.distrust("a", "a probe")
    assert again == [Distrusted("a", "a probe", 2)]


def test_a_doubtful_answer_is_decided_in_place() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    effects = dispatch.suspected(tag_of(dispatch.submit(job("j"))), "answered NaN")
    assert places(effects) == [IN_PLACE]
    assert dispatch.distrusted == []
    assert dispatch.done(tag_of(effects), done("j"))[0] == Distrusted("a", "answered NaN", 1)


def test_a_worker_gets_no_more_jobs_of_a_kind_it_does_not_know() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    unknown = Refused("unknown_kind", "", {})
    assert places(dispatch.failed(tag_of(dispatch.submit(Job("j", "idp", b""))), unknown)) == [IN_PLACE]
    assert (dispatch.slots("idp"), dispatch.slots("batch"), dispatch.distrusted) == (0, 1, [])
    assert places(dispatch.submit(Job("k", "idp", b""))) == [IN_PLACE]
    assert places(dispatch.submit(job("l"))) == ["a"]
    dispatch.cannot("a", "batch")
    assert dispatch.slots("batch") == 0
    dispatch.joined("a", 1)
    assert dispatch.slots("idp") == 1, "begun anew it may be another program"


def test_a_worker_that_did_not_answer_in_time_gets_nothing_until_it_is_heard_of() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    dispatch.joined("b", 2)
    effects = dispatch.failed(tag_of(dispatch.submit(job("j"))), TIMEOUT)
    assert places(effects) == ["b"]
    assert (dispatch.suspects, dispatch.slots("batch")) == (["a"], 2)
    assert [places(dispatch.submit(job(name))) for name in "klm"] == [["b"], [], []]
    assert places(dispatch.heard("a")) == ["a"]
    assert (dispatch.suspects, dispatch.slots("batch")) == ([], 3)
    ended, *following = dispatch.done(tag_of(effects), done("j"))
    assert ended == Ended("j", "b", done("j"))
    assert isinstance(ended, Ended)
    assert ended.tries == 2
    assert places(following) == ["b"]


def test_short_jobs_may_wait_at_a_worker_once_nobody_is_free() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    dispatch.joined("b", 1)
    sent = [places(dispatch.submit(job(name), ahead=1)) for name in "jklmn"]
    assert sent == [["a"], ["b"], ["a"], ["b"], []]
    assert places(dispatch.submit(job("o"))) == [], "a long one does not"


def test_when_all_are_suspects_it_is_done_in_place() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    assert places(dispatch.failed(tag_of(dispatch.submit(job("j"))), TIMEOUT)) == [IN_PLACE]
    assert places(dispatch.submit(job("k"))) == [IN_PLACE]


def test_a_late_answer_is_dropped_by_its_tag() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    late = tag_of(dispatch.submit(job("j")))
    effects = dispatch.left("a")
    assert places(effects) == [IN_PLACE]
    assert dispatch.done(late, done("j")) == []
    assert dispatch.failed(late, TIMEOUT) == []
    assert places(dispatch.done(tag_of(effects), done("j"))) == ["ended"]


def test_a_worker_that_came_back_has_forgotten_its_jobs() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    dispatch.submit(job("j"))
    assert places(dispatch.joined("a", 1)) == [IN_PLACE]
    assert dispatch.table() == [{"name": "a", "slots": 1, "in_flight": 0, "wrong": 0, "distrusted": False}]


def test_a_cancelled_job_is_forgotten_wherever_it_is() -> None:
    dispatch = Dispatch()
    dispatch.joined("a", 1)
    sent = dispatch.submit(job("j"))
    dispatch.submit(job("k"))
    dispatch.cancel("k")
    dispatch.cancel("j")
    assert dispatch.done(tag_of(sent), done("j")) == []
    assert dispatch.open_jobs == 0


@given(st.lists(st.tuples(st.sampled_from("jlfdx"), st.integers(0, 3)), max_size=80))
def test_every_job_ends_once_whatever_the_workers_do(operations: list[tuple[str, int]]) -> None:
    dispatch = Dispatch()
    sendings: list[Any] = []
    ended: list[str] = []
    submitted: list[str] = []

    def note(effects: list[Effect]) -> None:
        sendings.extend(e for e in effects if isinstance(e, Send | InPlace))
        ended.extend(e.job for e in effects if isinstance(e, Ended))

    for what, n in operations:
        if what == "j":
            note(dispatch.joined(f"w{n}", n + 1))
        elif what == "l":
            note(dispatch.left(f"w{n}"))
        elif what == "x":
            submitted.append(f"job{len(submitted)}")
            note(dispatch.submit(job(submitted[-1])))
        elif sendings:
            sending = sendings.pop(n % len(sendings))
            tag = sending.tag
            note(dispatch.failed(tag, TIMEOUT) if what == "f" else dispatch.done(tag, done(sending.job.job)))
        assert all(row["in_flight"] <= row["slots"] for row in dispatch.table())
    while sendings:
        sending = sendings.pop()
        note(dispatch.done(sending.tag, done(sending.job.job)))
    assert sorted(ended) == sorted(submitted)
