"""What is remembered of a refused insert is its answer, and nothing of the solver that refused it."""

import gc
import weakref
from typing import Any

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Change, Factors, Insert, Variables
from factorbus.service.config import Limits
from factorbus.service.core.events import Arrived, Verdict
from factorbus.service.journal.library import make_map_solver
from factorbus.solver import errors
from factorbus.solver.optimize.system import System

POSE = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
POINT = Variables("point2", np.array([1]), np.array([[2.0, 1]]))
BEARING = Factors("bearing_se2", np.array([[0, 1]]), np.array([[0.5]]), np.ones((1, 1)))
LANDMARK = Factors("landmark_se2", np.array([[0, 1]]), np.array([[2.0, 1]]), np.array([[1.0, 0, 1]]))


def arrived(sequence: int, insert: Insert) -> Arrived:
    return Arrived([], "a", sequence, 0, 100, 0, insert, 0.0)


@pytest.fixture
def systems(monkeypatch: pytest.MonkeyPatch) -> list[weakref.ref]:
    """The normal equations that were made meanwhile."""
    made: list[weakref.ref] = []
    begin = System.__init__

    def noted(self: System, *args: Any) -> None:
        made.append(weakref.ref(self))
        begin(self, *args)

    monkeypatch.setattr(System, "__init__", noted)
    return made


@pytest.mark.parametrize("what", ["insert", "change"])
def test_a_refusal_keeps_no_matrix_of_the_solver_alive(what: str, systems: list[weakref.ref]) -> None:
    map_solver = make_map_solver("bayes-tree", {}, 0, Limits())
    first = Batch((POSE, POINT), (LANDMARK,)) if what == "change" else Batch((POSE,))
    map_solver.apply_whole([arrived(1, Insert(1, first))])
    systems.clear()
    if what == "insert":
        refused = Insert(2, Batch((POINT,), (BEARING,)))
    else:
        refused = Insert(2, Batch(), changes=(Change("remove_factors", np.array([0])),))
    gc.collect()
    gc.disable()  # a service looks for cycles rarely
    try:
        events, _ = map_solver.apply_whole([arrived(2, refused)])
        (verdict,) = (event for event in events if isinstance(event, Verdict))
        problem = verdict.outcomes[0].answer
        assert isinstance(problem, errors.Underconstrained)
        assert (problem.__traceback__, problem.__cause__, problem.__context__) == (None, None, None)
        del events
        assert systems
        assert [each() for each in systems] == [None] * len(systems)
    finally:
        gc.enable()
