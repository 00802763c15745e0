"""`detail` has what `proto/README.md` §11 says: of a value that is not right, what was seen and what is wanted."""

import importlib
import inspect
import pickle
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import factorbus
from factorbus.client.pending_insert import PendingInsert
from factorbus.ownership import UnsafeFolder
from factorbus.proto.arrays import F64, I64
from factorbus.proto.problems import Problem, Refused
from factorbus.solver.errors import Diverged, OutOfBounds, SolverError

_SAMPLES: dict[Any, Any] = {
    str: "some",
    int: 3,
    float: 2.5,
    bool: True,
    object: 7,
    Any: 7,
    Path: Path("folder/some"),
    Exception: ValueError("some"),
    UnsafeFolder: UnsafeFolder("the folder", Path("some"), "everybody can write to it", "chmod go-w some"),
    PendingInsert: types.SimpleNamespace(request=types.SimpleNamespace(what="map m", because="silence"), sequence=3),
}


def sample(hint: Any) -> Any:
    """A value of the type that a parameter has."""
    if hint in _SAMPLES:
        return _SAMPLES[hint]
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        return sample(arguments[0])
    if origin is tuple and Ellipsis not in arguments:
        return tuple(map(sample, arguments))
    if origin in (tuple, list, Sequence, Iterable):
        return (tuple if origin is tuple else list)([sample(arguments[0])] * 2)
    if origin is np.ndarray or hint in (F64, I64):
        return np.arange(2)
    if origin in (dict, Mapping):
        return {sample(arguments[0]): sample(arguments[1])}
    raise AssertionError(f"no sample of {hint}")


def made(kind: type[Problem] | type[SolverError]) -> Iterator[Problem | SolverError]:
    """Such errors: with the arguments that one needs, and with all of them."""
    hints = typing.get_type_hints(kind.__init__)
    parameters = [p for p in list(inspect.signature(kind.__init__).parameters.values())[1:] if p.kind != p.VAR_KEYWORD]
    for chosen in ([p for p in parameters if p.default is p.empty], parameters):
        plain = [sample(hints[p.name]) for p in chosen if p.kind == p.POSITIONAL_OR_KEYWORD]
        yield kind(*plain, **{p.name: sample(hints[p.name]) for p in chosen if p.kind == p.KEYWORD_ONLY})


def every_kind() -> list[type[Problem] | type[SolverError]]:
    """All errors of the package that travel as problems; Refused carries somebody else's detail."""
    for root in map(Path, factorbus.__path__):
        for path in root.rglob("*.py"):
            if re.search(r'^    code = "', path.read_text(), re.MULTILINE):
                importlib.import_module(".".join(("factorbus", *path.relative_to(root).with_suffix("").parts)))
    found, waiting = [], [Problem, SolverError]
    while waiting:
        kind = waiting.pop()
        found.append(kind)
        waiting += kind.__subclasses__()
    return sorted(
        {kind for kind in found if kind.__module__.startswith("factorbus.") and kind is not Refused},
        key=lambda kind: (kind.__module__, kind.__name__),
    )


EVERY_KIND = every_kind()


def test_the_kinds_are_found() -> None:
    codes = {kind.code for kind in EVERY_KIND}
    assert {"out_of_bounds", "diverged", "bad_sequence", "bad_name", "unknown_question", "bad_file"} <= codes
    assert {"journal_version", "bad_address", "bad_parameter", "bad_camera", "other_mode"} <= codes


@pytest.mark.parametrize("kind", EVERY_KIND, ids=lambda kind: f"{kind.__module__}.{kind.__name__}")
def test_what_was_seen_is_told_with_what_is_wanted_both_as_text(kind: type[Problem] | type[SolverError]) -> None:
    for problem in made(kind):
        assert ("seen" in problem.detail) == ("wanted" in problem.detail), problem.detail
        for name in {"seen", "wanted"} & set(problem.detail):
            assert isinstance(problem.detail[name], str), problem.detail
            assert problem.detail[name] in problem.message


@pytest.mark.parametrize("kind", [*EVERY_KIND, UnsafeFolder, Refused], ids=lambda kind: kind.__qualname__)
def test_it_goes_whole_to_another_process(kind: type[Problem] | type[SolverError]) -> None:
    """As what a worker of a pool raises does."""
    for problem in [Refused("odd", "some", {"where": "x1"})] if kind is Refused else made(kind):
        if any(isinstance(value, types.SimpleNamespace) for value in vars(problem).values()):
            continue  # a pending insert belongs to its session
        again = pickle.loads(pickle.dumps(problem))
        assert type(again) is type(problem)
        assert (str(again), again.args) == (str(problem), problem.args)
        assert (again.code, again.message, repr(again.detail)) == (problem.code, problem.message, repr(problem.detail))


@pytest.mark.parametrize(("least", "wanted"), [(-1e12, "at most 1e+12 in magnitude"), (1e-24, "1e-24 to 1e+24")])
def test_bounds_are_numbers_beside_the_text(least: float, wanted: str) -> None:
    most = 1e12 if least < 0 else 1e24
    detail = OutOfBounds("the value of se2 x1", 10 * most, least, most, "give a larger sigma").detail
    assert detail == {
        "where": "the value of se2 x1", "seen": f"{10 * most:g}", "wanted": wanted, "least": least, "most": most,
    }  # fmt: skip


def test_a_step_that_diverges_says_what_is_wanted_of_chi2_too() -> None:
    detail = Diverged("χ²", "inf", float("inf")).detail
    assert detail == {"where": "χ²", "seen": "inf", "wanted": "a finite number", "most": float("inf")}
