"""Whatever a call of the client is given is taken for what it is, or refused by name."""

import inspect
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from factorbus.client import (
    Camera,
    Changes,
    Draft,
    ImuNoise,
    Interest,
    cut_samples,
    initial_from_standstill,
    preintegrate_samples,
)
from factorbus.proto.interest import checked_interest
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.problems import BadOption, Problem
from factorbus.proto.symbols import symbol

MASKED: Any = np.ma.masked_array([1.0, 2.0, 3.0], [False, True, False])
MASKED_KEYS: Any = np.ma.masked_array([1, 2, 3], [False, True, False])


ODD: tuple[Any, ...] = (
    None, True, 0, -1, 2**70, 10**400, 1.5, float("nan"), float("inf"), 1 + 2j, "x1", "", "é", "x-1", " x1", b"x1",
    [], [1], [1, 2], (1, 2, 3), [[1, 2], [3, 4]], [[1], [2, 3]], [1, "2", 3], [1 + 2j, 0, 0], {}, {"a": 1}, {1, 2},
    range(3), object(), int, np.zeros(3), np.zeros((3, 3)), np.zeros(3, complex), MASKED,
    MASKED_KEYS, np.array(["a", "b", "c"]), np.array([None, 1, 2]), np.array([1, 2, 3], "M8[s]"),
    np.datetime64("2026-01-01"), np.float32(3), np.int8(3),
)  # fmt: skip

ARGUMENTS = {
    "key": "x0", "pose": "x0", "point": "l0", "first": "x0", "second": "x1", "seen": (0, 0, -1), "bearing": 0.1,
    "direction": (1, 0, 0), "theta": 0.1, "distance": 1.0, "feature": "f0", "pixel": (100.0, 100.0), "rho": 0.5,
    "camera": Camera("pinhole", (500.0, 500.0, 320.0, 240.0), 640, 480), "frame": "x1", "velocity": "v0",
    "latitude": 50.0, "longitude": 8.0, "height": 100.0, "origin": (50.0, 8.0, 100.0),
}  # fmt: skip
# Of methods whose parameters say less than all of it.
WHOLE: dict[str, dict[str, Any]] = {
    "variable": {"kind": "se2", "key": "x0", "value": (0, 0, 0)},
    "factor": {"kind": "between_se2", "keys": ("x0", "x1"), "measured": (1, 0, 0), "sigmas": (1, 1, 1)},
    "linear": {
        "keys": ("x0",), "values": [(0, 0, 0)], "jacobians": [np.eye(3)], "residual": (0, 0, 0), "kinds": ["se2"],
        "sigmas": (1, 1, 1),
    },
    "vector": {"key": "b0", "value": (0, 0)},
}  # fmt: skip
ELSEWHERE = ("batch", "order", "imu", "imu_preintegrated")  # no keywords of their own; held by tests of their own


def measured_by(kind: str) -> tuple[float, ...]:
    """Some measurement of that kind."""
    size = FACTOR_KINDS[kind].dim if kind.startswith("position") else FACTOR_KINDS[kind].size
    unit = {"se3": 7, "so3": 4, "sim3": 8}.get(kind.rpartition("_")[2])
    if unit != size:
        return (1.0,) * size
    return (1.0, 0, 0, 0, 0, 0, 1.0, 1.0)[:size] if size > 4 else (0, 0, 0, 1.0)


def good(name: str) -> dict[str, Any]:
    """Arguments with which the method `name` of a draft succeeds."""
    if name in WHOLE:
        return dict(WHOLE[name])
    if name in VARIABLE_KINDS:
        values = (0, 0, 0, 1) if name == "so3" else (0, 0, 0, 0, 0, 0, 1, 1)[: VARIABLE_KINDS[name].size]
        return {"key": "x0", "value": values}
    wanted = inspect.signature(getattr(Draft, name)).parameters.values()
    needed = [each.name for each in wanted if each.default is each.empty and each.kind != each.VAR_KEYWORD][1:]
    found = {each: measured_by(name) if each == "measured" else ARGUMENTS[each] for each in needed}
    if name == "idp_first":
        return {**found, "sigma_rho": 0.1}
    dim = 3 if name == "gnss" else FACTOR_KINDS[name].dim
    return {**found, "sigmas": (0.1,) * dim}


METHODS = [name for name in vars(Draft) if not name.startswith("_") and name not in ELSEWHERE]


def drafted(name: str, given: dict[str, Any]) -> Draft:
    made: Draft = getattr(Draft(), name)(**given)
    made.batch()
    return made


@pytest.mark.parametrize("name", METHODS)
def test_a_misspelt_keyword_is_refused_by_its_name(name: str) -> None:
    given = good(name)
    drafted(name, given)
    for keyword in ("sigma", "simgas", "los", "robust", "fixd", "stamps_", "informaton", "cov", "mount_", "zzz"):
        with pytest.raises((Problem, TypeError), match=f"'{keyword}'"):
            drafted(name, {**given, keyword: 1.0})


@pytest.mark.parametrize("name", METHODS)
def test_anything_is_taken_for_what_it_is_or_refused(name: str) -> None:
    given = good(name)
    others = ("loss", "information", "stamp", "fixed", "trusted", "mount", "bias", "scale", "offset", "lever")
    refused = 0
    for what in (*given, *others):
        for value in ODD:
            call = {**given, what: value}
            if what == "information":
                call.pop("sigmas", None)
            try:
                drafted(name, call)
            except Problem:
                refused += 1
            except TypeError as error:
                if "unexpected keyword argument" not in str(error):
                    raise
    assert refused > len(ODD)


LISTS = ("accept", "reject", "remove_factors", "fix", "free", "marginalize", "remove_variables")


@pytest.mark.parametrize("name", LISTS)
def test_a_change_takes_anything_for_what_it_is_or_refuses_it(name: str) -> None:
    refused = 0
    for value in ODD:
        try:
            getattr(Changes(), name)(value)
        except Problem:
            refused += 1
    assert refused > len(ODD) / 2


def wrong() -> Iterator[tuple[Callable[[], object], str]]:
    """Calls that NumPy would make something else of, and what is said of them."""
    time: Any = np.datetime64("2026-01-01")
    text: Any = b"x1"
    two: Any = [1e-3, 1e-3]
    edge: Any = {"sigmas": (1, 1, 1)}
    yield lambda: Draft().se2("x0", np.array([1 + 2j, 0, 0])), "not complex numbers"
    yield lambda: Draft().between_se2("x0", "x1", MASKED, **edge), "none of which is masked"
    yield lambda: Draft().between_se2("x0", "x1", (1, 0, 0), sigmas=MASKED), "none of which is masked"
    yield lambda: Draft().heading_se2("x0", time, sigmas=1), "not times"
    yield lambda: Draft().se2("x0", [0, 0, time]), "not times"
    yield lambda: Draft().se2("x0", np.array([1, 2, 3], "m8[s]")), "not durations"
    yield lambda: Draft().range_se2("x0", "l0", 10**400, sigmas=1), "range_se2: measured"
    yield lambda: Draft().factor("between_se2", text, (1, 0, 0), **edge), "b'x1'"
    yield lambda: Changes().remove_variables(text), "b'x1'"
    yield lambda: Changes().remove_factors(text), "b'x1'"
    yield lambda: Changes().fix(MASKED_KEYS), "wanted a text such as x12"
    yield lambda: ImuNoise(two, 1e-3, 1e-3, 1e-3), "gyroscope"


@pytest.mark.parametrize(("call", "said"), list(wrong()))
def test_what_numpy_would_make_something_else_of_is_refused(call: Callable[[], object], said: str) -> None:
    with pytest.raises(Problem) as refused:
        call()
    assert said in str(refused.value)


SAMPLES = np.column_stack([np.full(5, 0.01), np.zeros((5, 5)), np.full(5, 9.81)])
RATES = {"times_s": np.arange(6) / 100, "gyroscope": np.zeros((6, 3)), "accelerometer": np.ones((6, 3))}
NOISE = {"gyroscope": 1e-3, "accelerometer": 1e-2, "gyroscope_walk": 1e-5, "accelerometer_walk": 1e-4}
OTHERS: list[tuple[Callable[..., object], dict[str, Any]]] = [
    (Camera, {"model": "pinhole", "numbers": (500.0, 500.0, 320.0, 240.0), "width": 640, "height": 480}),
    (ImuNoise, NOISE),
    (lambda **of: checked_interest(Interest(**of)), dict.fromkeys(("letters", "kinds", "box", "period_ms"))),
    (cut_samples, {**RATES, "begin_s": 0.0, "end_s": 0.04, "longest_s": 1.0}),
    (initial_from_standstill, {"samples": SAMPLES, "gravity": 9.81}),
    (preintegrate_samples, {"samples": SAMPLES, "noise": ImuNoise(**NOISE), "bias": (0,) * 6}),
    (symbol, {"letter": "x", "index": 1}),
]  # fmt: skip


@pytest.mark.parametrize(("call", "given"), OTHERS)
def test_what_is_beside_the_draft_takes_anything_for_what_it_is_or_refuses_it(
    call: Callable[..., object], given: dict[str, Any]
) -> None:
    good = {name: value for name, value in given.items() if value is not None}
    call(**good)
    for name in given:
        refused = 0
        for value in ODD:
            try:
                call(**{**good, name: value})
            except Problem:
                refused += 1
        assert refused > len(ODD) / 2, name


def test_an_imu_at_rest_is_not_held_against_a_gravity_that_is_no_number() -> None:
    with pytest.raises(BadOption, match="gravity: nan"):
        initial_from_standstill(SAMPLES, gravity=float("nan"))


def test_a_linear_factor_is_trusted_as_any_other() -> None:
    (group,) = Draft().linear(**good("linear"), trusted=True).batch().factors
    assert group.trusted
