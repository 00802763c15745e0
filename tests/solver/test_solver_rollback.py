"""A step that is refused leaves everything as it was, to the bit, wherever in a map's life it happens."""

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.random_graphs import random_steps
from naive.solver_parts import graph_in, stepper_in, system_in

from examples import examples
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, errors

BATCH = Options(mode="all-batch")


def state(solver: Solver) -> list[bytes]:
    graph, blocks = graph_in(solver), system_in(solver).blocks
    variables, factors, values, payload, columns, scalars, *_ = graph.counts.tolist()
    arrays = [
        *(graph.keys[:variables], graph.var[:variables], graph.fac[:factors], graph.values[:values]),
        *(graph.payload[:payload], graph.dims[:columns], graph.stamps[:variables], graph.counts),
        *(blocks.pattern[:, : blocks.fill[0]], blocks.fill, blocks.data[: blocks.fill[1]], blocks.eta[:scalars]),
    ]
    steps = {name: part for name, part in solver.dump()["_stepper"].items() if name != "_system"}
    return [*(array.tobytes() for array in arrays), pickle.dumps(steps)]


def loose_ends(rng: np.random.Generator) -> Batch:
    """A pose in the plane that two points hold in two of its three directions, and new points on it."""
    keys = np.array([[-1, -2], [-1, -3]])
    return Batch(
        (
            Variables("se2", np.array([-1]), rng.normal(size=(1, 3))),
            Variables("point2", np.array([-2, -3]), rng.normal(size=(2, 2))),
        ),
        (Factors("landmark_se2", keys, rng.normal(size=(2, 2)), np.tile([2.0, 0.5, 1.0], (2, 1))),),
    )


@examples(40)
@given(seed=st.integers(0, 2**32 - 1), refuse=st.lists(st.booleans(), min_size=6, max_size=6), fold=st.integers(1, 3))
def test_refused_steps_leave_no_trace(seed: int, refuse: list[bool], fold: int) -> None:
    rng = np.random.default_rng(seed)
    tried, spared = Solver(BATCH), Solver(BATCH)
    for n, batch in enumerate(random_steps(seed, steps=6)):
        tried.stage(batch)
        spared.stage(batch)
        if n % fold == 0:
            assert tried.step().as_dict() == spared.step().as_dict()
        elif refuse[n]:
            tried.step()
            spared.step()
        if refuse[n] and tried.variable_count == stepper_in(tried).mark[0]:
            before = state(tried)
            tried.stage(loose_ends(rng))
            with pytest.raises(errors.Underconstrained) as caught:
                tried.step()
            assert caught.value.detail["key"] in (-1, -2, -3)
            assert state(tried) == before
    tried.step(settle=True)
    spared.step(settle=True)
    assert state(tried) == state(spared)


@examples(25)
@given(seed=st.integers(0, 2**32 - 1), cut=st.integers(0, 200))
def test_a_failure_anywhere_within_a_step_is_taken_back(seed: int, cut: int) -> None:
    """The clock is called throughout a step, so a clock that fails interrupts it anywhere."""

    class Interrupted(Exception):
        pass

    left = [10**9]

    def clock() -> float:
        left[0] -= 1
        if left[0] < 0:
            raise Interrupted
        return 0.0

    solver = Solver(Options(mode="all-batch", clock=clock))
    batches = list(random_steps(seed, steps=5, noise=0.2))
    for batch in batches[:3]:
        solver.stage(batch)
        solver.step()
    before = state(solver)
    for batch in batches[3:]:
        solver.stage(batch)
    left[0] = 1 + cut % 12
    try:
        solver.step(settle=True)
    except Interrupted:
        left[0] = 10**9
        assert state(solver) == before
        for batch in batches[3:]:
            solver.stage(batch)
        solver.step(settle=True)
    left[0] = 10**9
    twin = Solver(BATCH)
    for n, batch in enumerate(batches):
        twin.stage(batch)
        if n < 3:
            twin.step()
    twin.step(settle=True)
    assert state(solver) == state(twin)
