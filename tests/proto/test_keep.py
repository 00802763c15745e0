"""What a map keeps, as text: every form of it comes to one, and nothing wrong passes."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.proto.keep import KeepSettings, keep_text, try_keep
from factorbus.proto.problems import BadOption
from factorbus.solver.lifelong.policy import KeepPolicy

settings = st.builds(
    KeepSettings, st.integers(1, 10**6).map(lambda n: n / 1000), st.integers(1, 1000), st.integers(1, 10**9),
    st.integers(1, 10**9), st.integers(0, 1000).map(lambda n: n / 8),
)  # fmt: skip


@given(settings)
def test_the_text_of_settings_says_them(given: KeepSettings) -> None:
    text = keep_text(given)
    assert try_keep(text) == given
    assert keep_text(text) == text
    KeepPolicy(given.per_area_m, given.poses, given.window, given.landmarks, given.loss)  # takes what the text may say


def test_what_is_not_said_is_usual() -> None:
    assert try_keep("per_area=2") == KeepSettings(2.0, 1, 50, 2, 1.0)
    assert try_keep(" window=7 , per_area=0.5:3,loss=0") == KeepSettings(0.5, 3, 7, 2, 0.0)
    assert try_keep("all") is None
    assert keep_text("all") == "all"


@pytest.mark.parametrize("number", [2.0, 0.5, 1.23456789, 123456.789, 999999.9, 0.001, 1 / 3, 1e6])
def test_its_text_has_all_digits(number: float) -> None:
    """Else a map keeps by another policy than it was made with."""
    text = keep_text({"per_area": number, "loss": number})
    assert try_keep(text) == KeepSettings(number, 1, 50, 2, number)
    assert keep_text(text) == text


def test_a_mapping_is_as_good_as_text() -> None:
    wanted = keep_text("per_area=2:3,window=7")
    assert keep_text({"window": 7, "per_area": (2, 3)}) == keep_text({"per_area": "2:3", "window": 7}) == wanted
    assert keep_text({"per_area": 2.0}) == keep_text("per_area=2")


@pytest.mark.parametrize(
    "wrong",
    [
        "", "none", "window=5", "per_area", "per_area=", "per_area=x", "per_area=0", "per_area=2:", "per_area=2:0",
        "per_area=2:1.5", "per_area=nan", "per_area=inf", "per_area=2,window=-1", "per_area=2,window=0",
        "per_area=2,landmarks=2.5", "per_area=2,loss=-1", "per_area=2,per_area=3", "per_area=2,other=3",
        "per_area=2,window=99999999999999999999999", "all,per_area=2", "per_area=2;window=3",
        "per_area=1_0", "per_area=\uff12", "per_area=2,window=\uff11\uff12", "per_area=2,loss=1_0",
    ],
)  # fmt: skip
def test_anything_else_is_refused_and_says_what_was_wanted(wrong: str) -> None:
    with pytest.raises(BadOption, match="keep") as refused:
        try_keep(wrong)
    assert refused.value.detail["wanted"]


@pytest.mark.parametrize("wrong", [None, 5, 2.0, b"per_area=2", [2, 3], ("per_area", 2)])
def test_what_is_neither_text_nor_a_mapping_is_refused_so_too(wrong: Any) -> None:
    with pytest.raises(BadOption, match=rf"keep: is .*{type(wrong).__name__}"):
        keep_text(wrong)


def test_one_policy_has_one_text() -> None:
    assert keep_text("per_area=2,loss=-0") == keep_text("per_area=2,loss=0.0") == keep_text({"per_area": 2, "loss": 0})
