"""A number that is refused for being just outside its range is printed with the digits that show it."""

import re
from collections.abc import Callable

import numpy as np
import pytest

from factorbus.client import Draft
from factorbus.proto.messages import Batch, Change
from factorbus.solver import Options, Solver, SolverError
from factorbus.solver.changes.repair import repair
from factorbus.solver.changing import with_changes
from factorbus.wording import outside

PLANE = np.eye(3)
JUST = 1.0 + 1e-9


def held() -> Solver:
    solver = Solver(Options())
    solver.stage(between())
    solver.step()
    return solver


def between(**more: object) -> Batch:
    draft = Draft().se2("x0", (0, 0, 0), fixed=True).se2("x1")
    return draft.between_se2("x0", "x1", (1, 0, 0), **({"information": PLANE} | more)).batch()  # type: ignore[arg-type]


def staged(batch: Batch) -> Callable[[], object]:
    return lambda: Solver(Options()).stage(batch)


def weighed(weight: float, omega: float = 1.0) -> Callable[[], object]:
    solver = Solver(Options())
    solver.stage(between(information=omega * PLANE))
    solver.step()
    return lambda: with_changes(solver, (Change("weigh", factors=np.array([0]), weight=np.array([weight])),))


CASES: dict[str, tuple[Callable[[], object], float, float]] = {
    "value": (staged(Draft().point2("l0", (1e12 * JUST, 0), fixed=True).batch()), -1e12, 1e12),
    "information": (staged(between(information=1e24 * JUST * PLANE)), -1e24, 1e24),
    "least information": (staged(between(information=1e-24 / JUST * PLANE)), 1e-24, 1e24),
    "scale": (staged(between(loss=("huber", 1e12 * JUST))), 1e-12, 1e12),
    "quaternion": (staged(Draft().se3("x0", (0, 0, 0, 0, 0, 0, 1.001 + 1e-9), fixed=True).batch()), 0.999, 1.001),
    "weight": (weighed(1e-12 / JUST), 1e-12, 1e12),
    "probability": (lambda: repair(held().factor_graph, probability=1e-12 / JUST), 1e-12, 1 - 1e-12),
    "probability near 1": (lambda: repair(held().factor_graph, probability=1 - 1e-13), 1e-12, 1 - 1e-12),
}


@pytest.mark.parametrize("case", CASES)
def test_the_number_that_is_told_is_outside(case: str) -> None:
    refused, least, most = CASES[case]
    with pytest.raises(SolverError) as caught:
        refused()
    told = re.search(r"(?: is| at|length|seen|scale|probability:?) (-?[0-9][^ ,:]*)", str(caught.value))
    assert told is not None, str(caught.value)
    assert not least <= float(told[1]) <= most, str(caught.value)
    assert told[1] in str(caught.value.detail.get("seen", told[1]))


def test_digits_are_as_few_as_do() -> None:
    assert outside(1.8557e124, -1e12, 1e12) == "1.8557e+124"
    assert outside(1e12 / 3 * 10, -1e12, 1e12) == "3.33333e+12"
    assert outside(float("nan"), 0.0, 1.0) == "nan"
