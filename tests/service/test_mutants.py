"""The small form of `factorbus bench fuzz`: mutated messages into every decoder, admission, a solver and a service."""

import pytest
from bench import fuzz


def test_decoders_say_no_and_nothing_else() -> None:
    outcome = fuzz.decoders(20_000, seed=7)
    assert outcome.faults == []
    assert outcome.answers["ok"] > 100, "some of them are good"
    assert outcome.answers["bad_message"] > 100


def test_admission_refuses_whole() -> None:
    outcome = fuzz.admission(1_500, seed=7)
    assert outcome.faults == []
    assert outcome.answers["ok"] > 50
    assert outcome.answers["maps, same bits"] + outcome.answers["maps, same content"] > 1


@pytest.mark.timeout(300)
def test_a_live_service_answers_everything() -> None:
    outcome = fuzz.live(1_500, seed=7)
    assert outcome.faults == []
    assert outcome.answers["ok"] > 20
