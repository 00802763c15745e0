"""Who may insert what next: every rule of sequence numbers, room and turns."""

from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
import pytest
from hypothesis import given

from factorbus.proto.messages import Batch, Change, Insert
from factorbus.proto.problems import ShuttingDown, UnknownMap
from factorbus.service.config import Limits
from factorbus.service.core.admission import Admission
from factorbus.service.core.events import Answer, Arrived, Effect, Refuse

EPOCH = 77


def arrived(client: str, sequence: int, asker: Any = None, **changed: Any) -> Arrived:
    fields: dict[str, Any] = {"epoch": EPOCH, "size": 100, "digest": sequence, "now": 0.0} | changed
    content = Insert(sequence, Batch())
    return Arrived([asker or f"{client}{sequence}"], client, sequence, content=content, **fields)


def changing(client: str, sequence: int, **changed: Any) -> Arrived:
    return arrived(client, sequence, **changed)._replace(content=Insert(sequence, Batch(), changes=(Change("fix"),)))


def codes(effects: list[Effect]) -> list[str]:
    return [effect.problem.code if isinstance(effect, Refuse) else "answer" for effect in effects]


def taken(admission: Admission, most: int = 1000) -> list[str]:
    return [f"{w.client}{w.sequence}" for w in admission.take(most)]


@pytest.fixture
def admission() -> Admission:
    return Admission(EPOCH, Limits(waiting=4, waiting_bytes=1000, clients=3, remembered=2))


def test_numbers_in_order_are_admitted(admission: Admission) -> None:
    assert [admission.admit(arrived("a", s)) for s in (1, 2, 3)] == [[], [], []]
    assert taken(admission) == ["a1", "a2", "a3"]
    assert admission.next_sequences == {"a": 4}


def test_turns_go_round_the_clients(admission: Admission) -> None:
    for client, sequence in (("a", 1), ("a", 2), ("a", 3), ("b", 1)):
        admission.admit(arrived(client, sequence))
    assert taken(admission, 3) == ["a1", "b1", "a2"]
    assert taken(admission) == ["a3"]


def test_a_gap_is_waited_for_and_closed(admission: Admission) -> None:
    assert admission.admit(arrived("a", 3)) == []
    assert admission.admit(arrived("a", 2)) == []
    assert (admission.ready, admission.parked) == (0, 2)
    assert admission.admit(arrived("a", 1)) == []
    assert taken(admission) == ["a1", "a2", "a3"]


def test_the_same_number_while_it_waits_joins_those_who_wait(admission: Admission) -> None:
    admission.admit(arrived("a", 1))
    assert admission.admit(arrived("a", 1, asker="again")) == []
    (insert,) = admission.take(9)
    assert admission.answer(insert, b"yes") == [Answer("a1", b"yes"), Answer("again", b"yes")]


def test_of_too_many_who_wait_for_one_answer_the_first_is_sent_away(admission: Admission) -> None:
    sent_away = [e.asker for n in range(10) for e in admission.admit(arrived("a", 1, asker=f"try{n}"))]  # type: ignore[union-attr]
    assert sent_away == ["try0", "try1"]
    (insert,) = admission.take(9)
    assert [e.asker for e in admission.answer(insert, b"")] == [f"try{n}" for n in range(2, 10)]  # type: ignore[union-attr]


def test_the_same_number_later_gets_the_first_answer(admission: Admission) -> None:
    refusal = UnknownMap("m")
    for sequence, answer in ((1, b"first"), (2, refusal)):
        admission.admit(arrived("a", sequence))
        admission.answer(admission.take(1)[0], answer)
    assert admission.admit(arrived("a", 1, asker="again")) == [Answer("again", b"first")]
    assert admission.admit(arrived("a", 2, asker="again")) == [Refuse("again", refusal, 3)]


def test_an_answer_too_old_is_not_made_up(admission: Admission) -> None:
    for sequence in (1, 2, 3):
        admission.admit(arrived("a", sequence))
        admission.answer(admission.take(1)[0], b"")
    (effect,) = admission.admit(arrived("a", 1))
    assert isinstance(effect, Refuse)
    assert (effect.problem.code, effect.problem.detail["next"]) == ("bad_sequence", 4)


@pytest.mark.parametrize("state", ["waits", "answered"])
def test_a_number_used_for_other_bytes_is_refused(admission: Admission, state: str) -> None:
    admission.admit(arrived("a", 1))
    if state == "answered":
        admission.answer(admission.take(1)[0], b"")
    assert codes(admission.admit(arrived("a", 1, digest=99))) == ["bad_sequence"]


def test_a_number_beyond_the_window_is_refused_at_once(admission: Admission) -> None:
    assert codes(admission.admit(arrived("a", 5))) == ["bad_sequence"]
    assert admission.admit(arrived("a", 4)) == []


def test_another_epoch_is_refused_and_uses_nothing_up(admission: Admission) -> None:
    assert codes(admission.admit(arrived("a", 1, epoch=EPOCH + 1))) == ["wrong_epoch"]
    assert admission.next_sequences == {}
    assert admission.admit(arrived("a", 1, epoch=0)) == []


def test_a_full_inbox_is_busy_and_uses_nothing_up(admission: Admission) -> None:
    for sequence in range(1, 5):
        admission.admit(arrived("a", sequence))
    (effect,) = admission.admit(arrived("a", 5))
    assert isinstance(effect, Refuse)
    assert effect.problem.code == "busy"
    assert 0 < effect.problem.detail["retry_after_s"] <= 2
    admission.take(1)
    assert admission.admit(arrived("a", 5)) == []


def test_parked_inserts_cannot_keep_out_the_one_they_wait_for(admission: Admission) -> None:
    outcomes = [codes(admission.admit(arrived("a", s))) for s in (2, 3, 4)]
    outcomes += [codes(admission.admit(arrived("b", s))) for s in (2, 3)]
    assert outcomes == [[], [], [], [], ["busy"]]
    assert admission.admit(arrived("a", 1)) == []
    assert taken(admission) == ["a1", "a2", "a3", "a4"]


def test_the_inbox_is_bounded_in_bytes_too(admission: Admission) -> None:
    assert admission.admit(arrived("a", 1, size=5000)) == [], "an empty inbox takes one of any size"
    assert codes(admission.admit(arrived("a", 2))) == ["busy"]
    admission.answer(admission.take(1)[0], b"")
    assert admission.admit(arrived("a", 2)) == []


def test_a_gap_that_stays_is_refused(admission: Admission) -> None:
    admission.admit(arrived("a", 2, now=10.0))
    assert admission.expire(14.0) == []
    (effect,) = admission.expire(16.0)
    assert isinstance(effect, Refuse)
    assert (effect.asker, effect.problem.code, effect.problem.detail["next"]) == ("a2", "bad_sequence", 1)
    assert admission.parked == 0
    assert admission.admit(arrived("a", 1)) == []
    assert admission.admit(arrived("a", 2)) == [], "what was refused for a gap is not used up"


def test_too_many_clients(admission: Admission) -> None:
    assert [codes(admission.admit(arrived(c, 1))) for c in "abcd"] == [[], [], [], ["too_large"]]


def test_a_client_long_silent_makes_room(admission: Admission) -> None:
    for now, client in ((0.0, "a"), (1.0, "b"), (500.0, "c")):
        admission.admit(arrived(client, 1, now=now))
    assert codes(admission.admit(arrived("d", 1, now=700.0))) == ["too_large"], "all have something open"
    for insert in admission.take(9):
        admission.answer(insert, b"")
    admission.admit(arrived("a", 1, asker="again", now=650.0))
    assert admission.admit(arrived("d", 1, now=700.0)) == []
    assert set(admission.next_sequences) == {"a", "c", "d"}
    assert codes(admission.admit(arrived("e", 1, now=701.0))) == ["too_large"]


def test_of_one_sender_256_names_have_their_places_and_the_257th_makes_room_among_its_own() -> None:
    """What follows the last `-` is the suffix: a name is that of a sender up to there."""
    admission = Admission(EPOCH, Limits())
    others = [f"{name}-1" for name in "abc"]
    for now, client in enumerate([*others, *(f"rob-ot-{n:08x}" for n in range(256))]):
        assert codes(admission.admit(arrived(client, 1, now=float(now)))) == []
    assert codes(admission.admit(arrived("rob-ot-more", 1, now=300.0))) == ["too_large"], "all have something open"
    assert codes(admission.admit(arrived("rob-other", 1, now=300.0))) == [], "rob is another sender"
    for insert in admission.take(999):
        admission.answer(insert, b"")
    assert codes(admission.admit(arrived("rob-ot-more", 1, now=301.0))) == []
    assert {*others, "rob-ot-more", "rob-other", "rob-ot-00000001"} <= set(admission.next_sequences)
    assert "rob-ot-00000000" not in admission.next_sequences, "the one heard of longest ago"
    assert len(admission.next_sequences) == 3 + 256 + 1


def test_closing_keeps_what_was_admitted(admission: Admission) -> None:
    admission.admit(arrived("a", 1))
    admission.admit(arrived("a", 3))
    assert codes(admission.close()) == ["shutting_down"]
    assert codes(admission.admit(arrived("a", 2))) == ["shutting_down"]
    (insert,) = admission.take(9)
    assert admission.answer(insert, b"kept") == [Answer("a1", b"kept")]
    assert admission.admit(arrived("a", 1, asker="again")) == [Answer("again", b"kept")]


def test_closing_for_good_refuses_all_that_waits(admission: Admission) -> None:
    admission.admit(arrived("a", 1))
    admission.admit(arrived("a", 3))
    assert sorted(codes(admission.close(UnknownMap("m")))) == ["unknown_map", "unknown_map"]
    assert (admission.ready, admission.parked) == (0, 0)


OPERATIONS = st.one_of(
    st.tuples(
        st.just("admit"),
        st.sampled_from("abcde"),
        st.integers(1, 12),
        st.sampled_from([0, 0, 0, 1]),  # digest
        st.integers(1, 600),  # size
        st.sampled_from([EPOCH, EPOCH, EPOCH, 0, 1]),
    ),
    st.tuples(st.just("solve"), st.integers(1, 5)),
    st.tuples(st.just("expire")),
)


@given(st.lists(OPERATIONS, max_size=120))
def test_whatever_comes_everybody_is_answered_once_and_order_holds(operations: list[tuple[Any, ...]]) -> None:
    limits = Limits(waiting=5, waiting_bytes=2000, clients=4, remembered=6)
    admission = Admission(EPOCH, limits)
    asked: list[int] = []
    answered: list[int] = []
    solved: dict[str, list[int]] = {}
    now = 0.0

    def note(effects: list[Effect]) -> None:
        answered.extend(effect.asker for effect in effects if isinstance(effect, Answer | Refuse))

    def solve(most: int) -> None:
        for insert in admission.take(most):
            solved.setdefault(insert.client, []).append(insert.sequence)
            note(admission.answer(insert, f"{insert.client}{insert.sequence}".encode()))

    steps: dict[str, Callable[..., None]] = {"solve": solve, "expire": lambda: note(admission.expire(now))}
    for name, *arguments in operations:
        now += 1.0
        if name == "admit":
            client, sequence, digest, size, epoch = arguments
            asked.append(len(asked))
            event = arrived(client, sequence, asker=None, digest=digest, size=size, epoch=epoch, now=now)
            effects = admission.admit(event._replace(askers=[asked[-1]]))
            note(effects)
            for effect in effects:
                if isinstance(effect, Answer):
                    assert effect.message == f"{client}{sequence}".encode(), "an answer belongs to its number"
        else:
            steps[name](*arguments)
        assert admission.parked <= limits.waiting
        assert admission.ready <= 2 * limits.waiting
        assert len(admission.next_sequences) <= limits.clients
    note(admission.close(ShuttingDown()))
    assert sorted(answered) == asked
    for client, sequences in solved.items():
        assert sequences == list(range(1, len(sequences) + 1)), client


def test_a_change_goes_alone_and_counts_for_a_whole_step_in_the_order_of_turns() -> None:
    admission = Admission(EPOCH, Limits(waiting=200, clients=3))
    for sequence in (1, 2, 3):
        admission.admit(changing("a", sequence))
    assert taken(admission) == ["a1"]
    for sequence in range(1, 61):
        admission.admit(arrived("b", sequence))
    admission.admit(arrived("b", 61, size=40_000))
    assert taken(admission) == [f"b{n}" for n in range(1, 60)], "the second change does not begin before these"
    assert taken(admission) == ["a2"]
    assert taken(admission) == ["b60", "b61"]
    assert taken(admission) == ["a3"]


def test_of_one_client_so_many_changes_are_under_way_and_more_are_busy() -> None:
    admission = Admission(EPOCH, Limits(waiting=20, clients=3, changes=3))
    assert [admission.admit(changing("a", s)) for s in (1, 2, 4)] == [[], [], []]
    (effect,) = admission.admit(changing("a", 3))
    assert isinstance(effect, Refuse)
    assert (effect.problem.code, effect.following) == ("busy", 3), "not used up"
    assert 0 < effect.problem.detail["retry_after_s"] <= 2
    assert "3 changes of this client" in str(effect.problem)
    assert admission.admit(changing("b", 1)) == [], "another one's are its own"
    assert admission.admit(arrived("a", 3)) == [], "an insert that only adds is no change"
    (first,) = admission.take(9)
    assert codes(admission.admit(changing("a", 5))) == ["busy"], "the solver has one, which is not answered"
    admission.answer(first, b"")
    assert admission.admit(changing("a", 5)) == []
