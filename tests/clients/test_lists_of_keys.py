"""Keys that are given one by one, where a list of them is wanted, are not taken for a time limit."""

import asyncio
import inspect
from collections.abc import Callable
from typing import Any

import pytest

from factorbus.client import Bus, Features, Map, aio
from factorbus.client.aio_uncertainty import Uncertainty as AioUncertainty
from factorbus.client.questions import Questions
from factorbus.client.uncertainty import Uncertainty, UncertaintyQuestions
from factorbus.proto.problems import BadShape

NO_SENDER: Any = None  # nothing is sent
QUESTIONS = UncertaintyQuestions(NO_SENDER, "hall", 1.0)
CALLS: dict[str, tuple[Callable[[Any], Any], str]] = {
    "joint": (lambda u: u.joint("x0", "x4"), "joint: 'x0', 'x4', one by one; wanted a list: joint(['x0', 'x4'])"),
    "covariance": (
        lambda u: u.covariance(1, 2, 3),
        "covariance: 1, 2, 3, one by one; wanted a list: covariance([1, 2, 3])",
    ),
    "relative": (
        lambda u: u.relative(("x0", "x4"), ("x1", "x2")),
        "relative: ('x0', 'x4'), ('x1', 'x2'), one by one; wanted a list: relative([('x0', 'x4'), ('x1', 'x2')])",
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_keys_one_by_one_are_refused_with_the_list_that_is_meant(name: str) -> None:
    call, said = CALLS[name]
    with pytest.raises(BadShape) as refused:
        call(Uncertainty(QUESTIONS))
    assert said in refused.value.message
    with pytest.raises(BadShape) as refused:
        asyncio.run(call(AioUncertainty(QUESTIONS)))
    assert said in refused.value.message


def test_of_an_estimate_too() -> None:
    bare = object.__new__(Map)
    bare.ask = Questions(NO_SENDER, "hall", 1.0)
    with pytest.raises(BadShape, match=r"wanted a list: ask_estimate\(\['x0', 'x4'\]\)"):
        bare.ask_estimate("x0", "x4")


WAITS = {"result", "wait_for"}  # of one answer, of one revision: what is behind it is a time


@pytest.mark.parametrize("of", [Bus, Map, Features, Uncertainty, aio.Bus, aio.Map, aio.Features, AioUncertainty])
def test_a_time_limit_behind_another_argument_has_its_name(of: type) -> None:
    for name, method in inspect.getmembers(of, inspect.isfunction):
        if name.startswith("_") or name in WAITS or name == "again_without_memory":
            continue
        given = [each for each in inspect.signature(method).parameters.values() if each.name != "self"]
        behind = [each for each in given[1:] if each.name == "timeout_s"]
        assert all(each.kind is inspect.Parameter.KEYWORD_ONLY for each in behind), f"{of.__name__}.{name}"
