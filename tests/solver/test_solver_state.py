"""A solver that goes on from another one's state makes the same steps, to the bit, in every mode."""

import json
from typing import Any

import numpy as np
import pytest
from naive.random_graphs import random_steps
from naive.solver_parts import graph_in

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver, errors
from factorbus.solver.build import differences, present_build
from factorbus.solver.modes import MODES
from factorbus.solver.state import dump

STEPS = 60


def reported(report: Any) -> dict[str, Any]:
    """All of a report but the times."""
    timed = {"phases_ms", "step_ms", "compiled_ms"}
    return {name: value for name, value in report.as_dict().items() if name not in timed}


def bits(groups: Any) -> list[Any]:
    return [
        (g.kind, g.keys.tobytes(), g.values.tobytes(), g.fixed, g.stamps is not None and g.stamps.tobytes())
        for g in groups
    ]


def loose() -> Batch:
    """What a step refuses: a pose that two points hold in two of its three directions."""
    keys = np.array([[-1, -2], [-1, -3]])
    points = Variables("point2", np.array([-2, -3]), np.array([[1.0, 2.0], [2.0, 1.0]]))
    seen = Factors("landmark_se2", keys, np.ones((2, 2)), np.tile([2.0, 0.5, 1.0], (2, 1)))
    return Batch((Variables("se2", np.array([-1]), np.zeros((1, 3))), points), (seen,))


def as_text_and_back(state: Any) -> Any:
    """By a form without objects: what cannot go over that would not go into a file."""

    def plain(value: Any) -> Any:
        return {"a": [str(value.dtype), list(value.shape), value.tobytes().hex()]}

    def whole(content: dict[str, Any]) -> Any:
        if set(content) == {"a"}:
            dtype, shape, numbers = content["a"]
            return np.frombuffer(bytes.fromhex(numbers), dtype).reshape(shape)
        return content

    return json.loads(json.dumps(state, default=plain), object_hook=whole)


def same_step(one: Solver, other: Solver, batch: Batch, settle: bool) -> None:
    for solver in (one, other):
        solver.stage(batch)
    assert reported(one.step(settle)) == reported(other.step(settle))
    assert bits(one.changed()) == bits(other.changed())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", [1, 2])
def test_going_on_from_a_state_is_not_having_stopped(mode: str, seed: int) -> None:
    """Stopped after each of many steps, ordinary, settling and refused ones, so that every kind of state occurs."""
    options = Options(mode=mode)
    kept, gone_on = Solver(options), Solver(options)
    for n, batch in enumerate(random_steps(seed, steps=STEPS)):
        same_step(kept, gone_on, batch, settle=n % 17 == 16)
        if n % 13 == 12:
            for solver in (kept, gone_on):
                solver.stage(loose())
                with pytest.raises(errors.Underconstrained):
                    solver.step()
        if n % 3 == 0:
            state = as_text_and_back(gone_on.dump())
            gone_on = Solver(options)
            gone_on.load(state)
    assert bits(kept.estimate()) == bits(gone_on.estimate())
    assert kept.chi2() == gone_on.chi2()
    assert kept.memory_bytes() == gone_on.memory_bytes()


def test_a_state_is_a_copy() -> None:
    first, *others = random_steps(3, steps=5)
    solver = Solver()
    solver.stage(first)
    solver.step()
    state = solver.dump()
    for batch in others:
        solver.stage(batch)
        solver.step()
    restored = Solver()
    restored.load(state)
    assert restored.variable_count == first.variable_count
    for batch in others:
        restored.stage(batch)
        restored.step()
    assert bits(restored.estimate()) == bits(solver.estimate())


def test_what_no_state_can_hold_is_an_error_and_so_is_a_state_of_something_else() -> None:
    solver = Solver()
    state = solver.dump()
    graph_in(solver).forgotten = object()  # type: ignore[attr-defined]
    with pytest.raises(TypeError, match=r"Graph\.forgotten is a object"):
        dump(solver)
    with pytest.raises(ValueError, match="no state of Solver: _graph"):
        Solver().load({name: value for name, value in state.items() if name != "_graph"})
    with pytest.raises(ValueError, match="in one of them only"):
        Solver(Options(mode="bayes-tree")).load(Solver(Options(mode="bayes-tree")).dump() | {"_stepper": {"_tree": {}}})


def test_a_state_with_other_arrays_is_refused() -> None:
    """Kernels would read past them."""
    first, *_ = random_steps(3, steps=1)
    solver = Solver()
    solver.stage(first)
    solver.step()
    for changed in (lambda fac: fac[:, 0].copy(), lambda fac: fac.astype(np.int32), lambda fac: None):
        state = solver.dump()
        state["_graph"]["fac"] = changed(state["_graph"]["fac"])
        with pytest.raises(
            ValueError, match=r"no state of a solver here: FactorGraph\.fac is .*, wanted int64 in 2 dim"
        ):
            Solver().load(state)


def test_a_build_is_known_by_all_that_bits_depend_on() -> None:
    here = present_build()
    assert set(here) == {"sources", "processor", "versions", "flags"}
    assert all(here[name] for name in ("sources", "processor", "versions"))
    assert differences(here, here) == ""
    other = {**here, "processor": "x86_64 i486", "sources": "0"}
    assert differences(other, here) == (
        f"sources 0, here {here['sources']}; processor x86_64 i486, here {here['processor']}"
    )
    assert differences({}, {"flags": "A=1"}) == "flags none, here A=1"
