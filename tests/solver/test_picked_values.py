"""Values of some variables: runs of those that follow each other are copied together, however long they are."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from naive.solver_parts import graph_in

from factorbus.simulate import WORLDS
from factorbus.solver import Solver

COUNT = 70


def driven() -> Solver:
    solver = Solver()
    for step in WORLDS["manhattan"](COUNT, 2):
        solver.stage(step.batch)
        solver.step()
    return solver


SOLVER = driven()


@given(st.lists(st.booleans(), min_size=COUNT - 1, max_size=COUNT - 1))
def test_any_ascending_choice_has_its_own_keys_and_values(chosen: list[bool]) -> None:
    (whole,) = [group for group in SOLVER.estimate() if not group.fixed]
    picked = np.flatnonzero(chosen)
    groups = graph_in(SOLVER).variables(picked + 1)  # the first variable is fixed
    keys = np.concatenate([np.empty(0, np.int64), *[group.keys for group in groups]])
    values = np.concatenate([np.empty((0, 3)), *[group.values for group in groups]])
    assert keys.tolist() == whole.keys[picked].tolist()
    assert values.tolist() == whole.values[picked].tolist()
