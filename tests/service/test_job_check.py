"""What of a worker's answer is looked at before anybody gets it, and for how long a worker is distrusted."""

from typing import Any

import numpy as np
import pytest
from naive.random_cameras import random_observations

from factorbus.idp import job as idp_job
from factorbus.proto import codec
from factorbus.proto.features import Ask, Shard, ShardDone
from factorbus.proto.features_codec import decode_shard_done, encode_ask, encode_shard, encode_shard_done
from factorbus.proto.messages import Batch, Factors, Job, JobDone, MapGraph, Optimum, Variables
from factorbus.proto.symbols import symbol
from factorbus.service.jobs import running as service_jobs
from factorbus.service.jobs.dispatch import Ended
from factorbus.service.jobs.job_check import DoubtfulAnswer, WrongAnswer, checked_result
from factorbus.service.jobs.running import Jobs, do_here

N, FIRST, LAST = 7, 2, 5
FORMS = ("rows", "half", "factored")


def features_job(form: str) -> Job:
    ask = encode_ask(Ask(random_observations(3, N, 2)[0], form))
    return Job("j", "idp", encode_shard(Shard(ask, FIRST, LAST)))


def graph_job() -> Job:
    """x0 fixed; x1 once, by an odometry with a loss."""
    x0, x1 = symbol("x", 0), symbol("x", 1)
    variables = (
        Variables("se2", np.array([x0]), np.zeros((1, 3)), fixed=True),
        Variables("se2", np.array([x1]), np.array([[1.0, 0.0, 0.0]])),
    )
    measured, information = np.array([[1.5, 0.25, 0.125]]), np.array([[100.0, 0, 0, 100, 0, 400]])
    edge = Factors("between_se2", np.array([[x0, x1]]), measured, information, "huber", np.array([1.5]))
    other = Factors("prior_se2", np.array([[x1]]), np.array([[1.0, 0.0, 0.0]]), information)
    return Job("j", "batch", codec.encode_graph(MapGraph(1, 1, Batch(variables, (edge, other)))))


def done(job: Job, payload: bytes) -> JobDone:
    return JobDone(job.job, job.kind, payload, 0.5)


@pytest.mark.parametrize("job", [graph_job(), *map(features_job, FORMS)], ids=["batch", *FORMS])
def test_what_the_service_does_itself_passes(job: Job) -> None:
    answer = do_here(job)
    assert isinstance(answer, JobDone)
    assert checked_result(job, answer) is answer


def test_an_optimum_may_leave_out_what_is_fixed_and_may_not_move_it() -> None:
    job = graph_job()
    right = codec.decode_optimum(do_here(job).payload)
    free = tuple(group for group in right.variables if not group.fixed)
    assert len(free) < len(right.variables)
    short = done(job, codec.encode_optimum(Optimum(right.chi2, 1, free)))
    assert checked_result(job, short) is short
    (fixed,) = (group for group in right.variables if group.fixed)
    moved = Variables("se2", fixed.keys, np.ones((1, 3)), fixed=True)
    answer = done(job, codec.encode_optimum(Optimum(right.chi2, 1, (*free, moved))))
    assert checked_result(job, answer) is answer, "it is held where it is, whatever a worker says"


def test_an_optimum_may_say_that_it_has_not_converged_and_says_it_with_a_bool() -> None:
    job = graph_job()
    right = codec.decode_map(do_here(job).payload)
    assert "converged" not in right
    early = done(job, codec.encode_map(right | {"converged": False}))
    assert checked_result(job, early) is early
    for wrong in ("no", 0, None):
        answer = checked_result(job, done(job, codec.encode_map(right | {"converged": wrong})))
        assert type(answer) is WrongAnswer
        assert "converged" in answer.message


@pytest.mark.parametrize("form", FORMS)
def test_arrays_of_features_have_the_shapes_of_their_form(form: str) -> None:
    job = features_job(form)
    right = decode_shard_done(do_here(job).payload)
    for name in right._fields[2:-1]:
        if (array := getattr(right, name)) is None:
            continue
        for wrong, kind in ((array[:-1], WrongAnswer), (np.full_like(array, np.inf), DoubtfulAnswer)):
            answer = encoded(right._replace(**{name: wrong}))
            assert type(checked_result(job, done(job, answer))) is kind, name
    for other in set(FORMS) - {form}:
        there = idp_job.do(features_job(other).payload)
        assert isinstance(checked_result(job, done(job, there)), WrongAnswer)
    assert isinstance(checked_result(job, done(job, encoded(right._replace(stored=True, rows=None)))), JobDone) == (
        form != "rows"
    ), "there is no segment to store it in"


def encoded(shard: ShardDone) -> bytes:
    """Also with arrays that no reader would take."""
    return encode_shard_done(shard)


class Control:
    """Does at once what it is handed."""

    def hand(self, call: Any, *arguments: Any) -> None:
        call(*arguments)


def test_a_worker_is_tried_again_after_a_while_that_doubles(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 1000.0
    monkeypatch.setattr(service_jobs.time, "monotonic", lambda: now)
    sent: list[str] = []

    def send(worker: str, job: Job, _deadline_s: float, came: Any) -> None:
        sent.append(worker)
        came(WrongAnswer("answered nonsense"))

    jobs = Jobs(Control(), send)  # type: ignore[arg-type]
    jobs.joined("a", 1)
    ends: list[Ended] = []
    for waits_s in (60.0, 120.0):
        jobs.submit("bake", b"", ends.append, 1.0, 1e6)
        assert jobs.distrusted == ["a"]
        for passed_s, distrusted in ((waits_s - 1, ["a"]), (2, [])):
            now += passed_s
            jobs.tick()
            assert jobs.distrusted == distrusted
    assert (sent, jobs.wrong_answers) == (["a", "a"], 2)
    jobs.submit("bake", b"", ends.append, 1.0, 1e6)
    jobs.joined("a", 1)
    assert jobs.distrusted == [], "it has begun anew"


def test_a_job_that_takes_longer_than_was_allowed_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same goes to a client that asks for the batch optimum; a late answer reaches nobody."""
    now, sent = 1000.0, list[Any]()
    monkeypatch.setattr(service_jobs.time, "monotonic", lambda: now)
    jobs = Jobs(Control(), lambda _worker, job, _deadline_s, came: sent.append((job, came)))  # type: ignore[arg-type]
    jobs.joined("a", 1)
    ends: list[Ended] = []
    jobs.submit("batch", graph_job().payload, ends.append, 60.0, 2.5)
    for passed_s, given_up in ((2.4, False), (0.2, True)):
        now += passed_s
        jobs.tick()
        assert [getattr(end.result, "code", None) for end in ends] == ["unavailable"] * given_up
    assert "2.5 s" in str(ends[0].result)
    ((job, came),) = sent
    came(do_here(Job(job.job, "batch", job.payload)))
    assert len(ends) == 1
