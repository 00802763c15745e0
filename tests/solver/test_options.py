"""Every option that is not what it should be is refused by name; every one that is, is taken."""

import dataclasses
import math
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from examples import examples
from factorbus.solver import Options, Solver, Tuning
from factorbus.solver.errors import BadOption, SolverError
from factorbus.solver.option_ranges import RANGES, SWITCHES

TEXTS = ("mode", "backend")
FIELDS = (*dataclasses.fields(Options), *dataclasses.fields(Tuning))
JUNK = st.one_of(
    st.none(), st.text(max_size=4), st.complex_numbers(), st.binary(max_size=2), st.lists(st.integers(), max_size=2)
)


def test_every_option_has_a_range_or_is_a_switch_or_a_text() -> None:
    assert {field.name for field in FIELDS} == {*RANGES, *SWITCHES, *TEXTS, "clock", "tuning"}
    for field in FIELDS:
        if field.name in RANGES:
            assert RANGES[field.name].takes(field.default)
            assert RANGES[field.name].whole == (field.type in (int, "int"))


@pytest.mark.parametrize("name", sorted(RANGES))
def test_a_number_out_of_its_range_is_refused_by_name(name: str) -> None:
    allowed = RANGES[name]
    for wrong in (
        math.nan,
        -1,
        -math.inf,
        "x",
        "0.5",
        None,
        True,
        [1],
        1j,
        allowed.least - 1,
        10**400,
        2.5 if allowed.whole else "1",
    ):
        with pytest.raises(BadOption, match=f"option {name}: seen") as refused:
            Options.of(**{name: wrong})
        assert refused.value.detail["where"] == name
        assert refused.value.detail["wanted"] == str(allowed)


# Thresholds that may be infinite: what they are the threshold of then never happens, and a step says what is left to
# do all the same.
OFF_WHEN_INFINITE = {
    "relinearize_threshold",
    "relinearize_max_error",
    "relinearize_cooldown_flops",
    "reroot_min_flops",
    "reroot_period",
    "reroot_ring_ratio",
    "reroot_max_extra",
}


@pytest.mark.parametrize("name", sorted(RANGES))
def test_infinity_is_refused_but_where_it_turns_something_off(name: str) -> None:
    if name in OFF_WHEN_INFINITE:
        assert Options.of(**{name: math.inf}).as_dict()[name] == math.inf
        return
    with pytest.raises(BadOption, match=f"option {name}: seen inf"):
        Options.of(**{name: math.inf})


@pytest.mark.parametrize("name", [*SWITCHES, "clock", "mode", "backend"])
def test_what_is_no_switch_no_clock_and_no_name_is_refused(name: str) -> None:
    for wrong in (1, 0.0, "yes", math.nan, []):
        with pytest.raises(SolverError, match=r"seen|no mode"):
            Options.of(**{name: wrong})


@examples(300)
@given(name=st.sampled_from(sorted(RANGES)), value=st.floats() | st.integers() | st.booleans() | JUNK)
def test_any_value_is_taken_as_it_is_or_refused(name: str, value: Any) -> None:
    allowed = RANGES[name]
    number = not isinstance(value, bool) and isinstance(value, int if allowed.whole else (int, float))
    right = number and not math.isnan(value) and allowed.least <= value <= allowed.most
    right = right and (isinstance(value, float) or abs(value) <= sys.float_info.max)
    right = right and not (allowed.above and value == allowed.least)
    if name in ("small_loop_threshold", "big_loop_threshold") and right:
        right = (
            value <= Options().tuning.big_loop_threshold
            if name == "small_loop_threshold"
            else value >= Options().tuning.small_loop_threshold
        )
    if right:
        assert Options.of(**{name: value}).as_dict()[name] == value
    else:
        with pytest.raises(BadOption):
            Options.of(**{name: value})


@pytest.mark.parametrize("options", [5, "bayes-tree", {"mode": "auto"}, 0, ""])
def test_what_is_no_options_is_refused(options: Any) -> None:
    with pytest.raises(BadOption, match="wanted an Options"):
        Solver(options)
