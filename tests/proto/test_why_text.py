"""What `ask/why` says in words of what χ² would be without a factor."""

import pytest

from factorbus.proto.why_text import fall_without, why_text


@pytest.mark.parametrize(
    ("without", "said"),
    [
        (0.5, "about 0.5"),
        (1.87, "about 1.87"),
        (1.8701, "about 1.87"),
        (2.8, "at most 1.87, which is all of χ² (2.8 to first order)"),
    ],
)
def test_no_fall_is_more_than_all_of_chi2(without: float, said: str) -> None:
    assert fall_without(without, {"chi2": 1.87}) == said


def test_of_a_step_that_does_not_tell_chi2_there_is_no_bound() -> None:
    assert fall_without(2.8, {}) == "about 2.8"


def test_factors_of_a_variable_and_one_alone_are_held_against_the_step() -> None:
    factor = {"factor": 3, "kind": "between_se2", "keys": [1, 2], "chi2": 1.2, "without": 2.8}
    bounded = "χ² 1.2, without it χ² falls by at most 1.87, which is all"
    assert bounded in why_text(4, {}, factor, {"chi2": 1.87})
    assert bounded in why_text(4, {"key": 1, "factors": [factor]}, {}, {"chi2": 1.87})
