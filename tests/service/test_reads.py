"""What questions cost an insert: in one InsertBatch the solver's thread does so much for them, however many wait."""

import threading
from typing import Any

import numpy as np
import pytest

import factorbus.service.bus.delivery as delivery
import factorbus.solver.covariance.source as source_of
from factorbus.proto import asking, asking_codec, codec
from factorbus.proto.messages import Batch, Factors, Insert, Variables
from factorbus.service.bus.delivery import Delivery
from factorbus.service.config import Limits
from factorbus.service.core.events import Applied, Arrived, ArrivedQuestion, Effect, InsertBatch, Read
from factorbus.service.core.map_state import MapCore
from factorbus.service.core.pending_questions import Reads
from factorbus.service.questions.answers import Question, QuestionCopies, answer, parse, snapshot
from factorbus.service.questions.uncertainty import NEAR
from factorbus.solver import Options, Solver

PATIENCE_S = 60.0


def covariance(keys: int, blocks: str = "joint") -> bytes:
    named = None if blocks == "last" else np.arange(keys)
    return asking_codec.encode_ask_covariance(asking.AskCovariance(blocks, named))


def gate(candidates: int) -> bytes:
    keys, information = np.tile([0, 1], (candidates, 1)), np.tile([1.0, 0, 0, 1, 0, 1], (candidates, 1))
    factors = (Factors("between_se2", keys, np.zeros((candidates, 3)), information),)
    return asking_codec.encode_ask_gate(asking.AskGate(factors))


def why_factor() -> bytes:
    return asking_codec.encode_ask_why(asking.AskWhy(factor=0))


def taken(*questions: tuple[str, bytes]) -> tuple[list[int], int]:
    """Which of them the first InsertBatch takes, and after how many Runs none is left."""
    reads, runs = Reads(), 1
    for n, (name, payload) in enumerate(questions):
        reads.append(Read(parse(name, payload), n))
    first = [read.asker for read in reads.take()]
    while len(reads):
        reads.take()
        runs += 1
    return first, runs


def test_a_run_answers_questions_about_so_many_variables_on_the_spot() -> None:
    assert NEAR == 8
    assert taken(*[("covariance", covariance(8))] * 5) == ([0], 5)
    assert taken(*[("covariance", covariance(3))] * 5) == ([0, 1], 3)
    assert taken(*[("covariance", covariance(0, "last"))] * 17) == (list(range(8)), 3)
    assert taken(*[("gate", gate(4))] * 3) == ([0], 3)
    assert taken(*[("gain", gate(1))] * 5) == ([0, 1, 2, 3], 2)
    assert taken(*[("why", why_factor())] * 5) == ([0, 1, 2, 3], 2)


def test_questions_that_take_a_copy_go_together_and_the_others_keep_their_order() -> None:
    large = ("covariance", covariance(9)), ("covariance", b""), ("graph", b""), ("estimate", b""), ("repair", b"")
    assert taken(*large * 50) == (list(range(250)), 1)
    near = ("covariance", covariance(6))
    assert taken(near, ("graph", b""), near, ("covariance", covariance(1)), ("chi2", b"")) == ([0, 1, 4], 2)


def test_inserts_are_taken_between_them() -> None:
    core = MapCore("m", "bayes-tree", 5, Limits(), now=0.0)
    run = run_of(core.ask(ArrivedQuestion(0, "covariance", covariance(8)), 1.0))
    for n in range(1, 100):
        core.ask(ArrivedQuestion(n, "covariance", covariance(8)), 1.0)
    core.insert(Arrived(["a1"], "a", 1, 0, 10, 1, Insert(1, Batch()), 1.0))
    run = run_of(core.applied(Applied(3, 4, 0.5, 2.0)))
    assert ([read.asker for read in run.reads], [insert.sequence for insert in run.inserts]) == ([1], [1])
    asked: list[Any] = []
    while effects := core.applied(Applied(3, 4, 0.5, 3.0)):
        asked += [read.asker for read in run_of(effects).reads]
    assert asked == list(range(2, 100))


def run_of(effects: list[Effect]) -> InsertBatch:
    (run,) = [effect for effect in effects if isinstance(effect, InsertBatch)]
    return run


def solved(mode: str) -> Solver:
    solver = Solver(Options(mode=mode))
    keys, information = np.array([[0, 1]]), np.array([[100.0, 0, 0, 100, 0, 400]])
    fixed = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
    moving = Variables("se2", np.array([1]), np.array([[1.0, 0, 0]]))
    solver.stage(Batch((fixed, moving), (Factors("between_se2", keys, np.array([[1.0, 0, 0]]), information),)))
    solver.step()
    return solver


@pytest.mark.parametrize("mode", ["inc-l", "all-batch"])
def test_a_mode_without_a_tree_is_factorized_by_who_answers(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    solver, made = solved(mode), list[int]()
    real = source_of.computed_square_root
    monkeypatch.setattr(source_of, "computed_square_root", lambda graph: made.append(1) or real(graph))
    question = parse("covariance", b"")
    copy = snapshot(solver, 1, 1, [question], {})
    assert not made, "the solver's thread has other work"
    shift = Variables("se2", np.array([2]), np.array([[2.0, 0, 0]]), fixed=True)
    solver.stage(Batch((shift,)))
    solver.step()
    for _ in range(2):
        found = asking_codec.decode_covariances(answer(question, copy))
        assert [group.keys.tolist() for group in found.groups] == [[0, 1]], "as the map was"
    np.testing.assert_allclose(found[1], np.diag([0.01, 0.01, 0.0025]), rtol=1e-9, atol=1e-15)
    assert len(made) == 1, "one factorization serves all questions about a revision"


class Answers:
    """What was sent, by asker; a question is computed when the test lets it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sent: dict[Any, Any] = {}
        self.arrived, self.go, self.begun = threading.Condition(), threading.Event(), threading.Semaphore(0)
        monkeypatch.setattr(delivery, "reply", self._send)
        monkeypatch.setattr(delivery, "refuse", lambda asker, problem, following=None: self._send(asker, problem))
        monkeypatch.setattr(delivery, "answer", self._compute)

    def wait_for(self, asker: Any) -> Any:
        with self.arrived:
            assert self.arrived.wait_for(lambda: asker in self.sent, PATIENCE_S)
            return self.sent[asker]

    def _send(self, asker: Any, message: Any) -> None:
        with self.arrived:
            self.sent[asker] = message
            self.arrived.notify_all()

    def _compute(self, question: Question, _: QuestionCopies) -> bytes:
        if question.name in ("covariance", "repair", "export"):
            self.begun.release()
            assert self.go.wait(PATIENCE_S)
        return question.name.encode()


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Any:
    answers = Answers(monkeypatch)
    made = Delivery(3, dict, _never, _never)
    yield answers, made
    answers.go.set()
    made.close()


def _never(*_: Any) -> None:
    raise AssertionError("no batch and no fork was asked for")


def test_what_is_ready_does_not_wait_for_what_is_computed(started: tuple[Answers, Delivery]) -> None:
    answers, made = started
    place: Any = None

    def ask(name: str, asker: Any) -> None:
        made.read(place, Read(Question(name), asker), QuestionCopies(1, 1))

    for n, name in enumerate(("covariance", "repair", "export")):
        ask(name, n)
    for _ in range(2):
        assert answers.begun.acquire(timeout=PATIENCE_S)
    made.tell("stats", {})
    ask("estimate", "estimate")
    made.answer("admin", b"rows")
    assert codec.decode_map(answers.wait_for("stats")) == {}
    assert (answers.wait_for("estimate"), answers.wait_for("admin")) == (b"estimate", b"rows")
    assert not {0, 1, 2} & set(answers.sent)
    ask("covariance", "one too many")
    assert answers.wait_for("one too many").code == "busy"
    answers.go.set()
    assert [answers.wait_for(n) for n in range(3)] == [b"covariance", b"repair", b"export"]
