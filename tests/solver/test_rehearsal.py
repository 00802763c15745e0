"""A rehearsal goes through a step up to where the tree would change, and leaves no trace."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from naive.random_graphs import random_steps

from factorbus.proto.messages import Batch, Variables
from factorbus.simulate import WORLDS
from factorbus.solver import Group, Options, Solver, tree_steps
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.rehearsal import NOBODY


@pytest.fixture(autouse=True)
def after_every_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree_steps, "_LONG", -1)


def bits(groups: list[Group]) -> list[tuple[str, bytes, bytes, bool]]:
    return [(g.kind, g.keys.tobytes(), g.values.tobytes(), g.fixed) for g in groups]


def account(report: Any) -> dict[str, Any]:
    told = report.as_dict()
    return {name: told[name] for name in told.keys() - {"phases_ms", "step_ms", "compiled_ms"}}


def eliminations(solver: Solver) -> int:
    assert solver._tree
    return int(solver._tree.tree.state[tl.S_STAMP])


def compare(steps: Iterable[Batch], least: float) -> None:
    """Drive two solvers, of which one rehearses; at least this share of its rehearsals comes to an elimination."""
    rehearsing, plain = Solver(Options()), Solver(Options())
    done = went = 0
    for batch in steps:
        assert rehearsing.stage(batch) == plain.stage(batch)
        assert account(rehearsing.step()) == account(plain.step())
        stamp = eliminations(rehearsing)
        rehearsing.rehearse()
        done, went = done + 1, went + (eliminations(rehearsing) > stamp)
        assert bits(rehearsing.changed()) == bits(plain.changed())
        assert rehearsing.chi2() == plain.chi2()
    assert bits(rehearsing.estimate()) == bits(plain.estimate())
    assert went >= least * done > 0


@pytest.mark.parametrize("seed", range(6))
def test_maps_of_all_kinds_have_the_same_bits(seed: int) -> None:
    compare(random_steps(seed, steps=40), least=0.5)


@pytest.mark.parametrize("world", ["manhattan", "sphere", "city_trees"])
def test_drives_have_the_same_bits(world: str) -> None:
    compare((step.batch for step in WORLDS[world](500, 3)), least=0.9)


def driven(poses: int = 60, **options: Any) -> Solver:
    solver = Solver(Options(**options))
    for step in WORLDS["manhattan"](poses, 1):
        solver.stage(step.batch)
        solver.step()
    return solver


def test_short_steps_are_not_followed_by_any(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = driven()
    assert solver._tree
    state = solver._tree.tree.state
    monkeypatch.setattr(tree_steps, "_LONG", int(state[tl.S_CHANGED] + state[tl.S_ELIMINATED]))
    stamp = eliminations(solver)
    solver.rehearse()
    assert eliminations(solver) == stamp


def test_what_is_staged_stays_staged() -> None:
    solver = driven()
    stamp = eliminations(solver)
    solver.stage(Batch((Variables("se2", np.array([-7]), np.zeros((1, 3)), fixed=True),)))
    solver.rehearse()
    assert eliminations(solver) == stamp
    assert solver.step().new_variables == 1


def test_a_map_with_nobody_in_it_is_left_alone() -> None:
    solver = driven()
    solver.stage(Batch((Variables("se2", np.array([NOBODY]), np.ones((1, 3)), fixed=True),)))
    solver.step()
    stamp, before = eliminations(solver), bits(solver.estimate())
    solver.rehearse()
    assert eliminations(solver) == stamp
    assert bits(solver.estimate()) == before


def test_it_makes_no_room() -> None:
    solver = driven()
    assert solver._tree
    tree = solver._tree.tree
    tree.numbers = tree.numbers[: tree.state[tl.S_NUMBERS]].copy()
    tree.state[tl.S_FREE : tl.S_FREE + tl.CLASSES] = 0  # nor is anything free
    numbers, before = tree.numbers, bits(solver.estimate())
    solver.rehearse()
    assert tree.numbers is numbers
    assert bits(solver.estimate()) == before
    twin = driven(61)
    *_, last = WORLDS["manhattan"](61, 1)
    solver.stage(last.batch)
    solver.step()
    assert bits(solver.estimate()) == bits(twin.estimate())


def test_other_modes_have_none() -> None:
    solver = driven(mode="inc-l")
    before = bits(solver.estimate())
    solver.rehearse()
    assert bits(solver.estimate()) == before
