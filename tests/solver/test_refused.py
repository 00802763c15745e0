"""What is refused leaves the whole state of a solver as it was, to the byte, in every mode; and the steps that follow
are those of a map that it never came to."""

from collections.abc import Callable
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.random_graphs import camera_steps, random_steps
from naive.states import flattened
from tested_maps import TestedMap, between, corridor

from examples import examples
from factorbus.client import Draft
from factorbus.client.expressions import SE2, Point2, Vector, factor, norm
from factorbus.proto.messages import Batch, Variables
from factorbus.solver import Options, Solver, errors

MODES = ["bayes-tree", "inc-l", "inc-l-b10", "all-batch"]
SIGMAS, HERE, ORIGIN = (0.1, 0.1, 0.1), "h0", (0.0, 0.0, 0.0)


def here() -> Draft:
    """A pose of its own, which the drafts below hang on."""
    return Draft().se2(HERE, ORIGIN).prior_se2(HERE, ORIGIN, sigmas=SIGMAS)


def free_pair() -> Draft:
    return Draft().se2("r0", ORIGIN).se2("r1").between_se2("r0", "r1", (1, 0, 0), sigmas=SIGMAS)


def many_free() -> Draft:
    """More than there is room for."""
    draft = Draft().se2("r0", ORIGIN)
    for n in range(700):
        draft.se2(f"r{n + 1}").between_se2(f"r{n}", f"r{n + 1}", (1, 0, 0), sigmas=SIGMAS)
    return draft


def one_range() -> Draft:
    return Draft().point2("r0", (3, 4)).range_se2(HERE, "r0", 5.0, sigmas=0.1)


@factor
def range_of_ours(a: SE2, l: Point2, z: Vector[1]):
    return norm(a.position - l) - z


def one_range_of_an_own_kind() -> Draft:
    """The kind is the map's only once it has a factor of it."""
    return Draft().point2("r0", (3, 4)).factor(range_of_ours, (HERE, "r0"), [5.0], sigmas=0.1)


def held_in_two_of_three() -> Draft:
    """Only the numbers of Λ can tell."""
    draft = Draft().se2("r0", (1, 1, 0))
    for n, place in enumerate([(2, 1), (1, 3)]):
        draft.point2(f"r{n + 1}", place).landmark_se2("r0", f"r{n + 1}", (1, 1), sigmas=(0.1, 0.1))
    return draft.landmark_se2(HERE, "r1", (2, 1), sigmas=(0.1, 0.1))


def set_aside_by_its_loss() -> Draft:
    far = {"sigmas": SIGMAS, "loss": ("tukey", 1.0)}
    return Draft().se2("r0", (900, 0, 0)).between_se2(HERE, "r0", (1, 0, 0), **far)


def held_with_one_that_is_not() -> Draft:
    return one_range().se2("r9").between_se2(HERE, "r9", (1, 0, 0), sigmas=SIGMAS)


def there_already() -> Draft:
    return Draft().se2("r0", ORIGIN, fixed=True).se2(HERE, ORIGIN)


def unknown_end() -> Draft:
    return Draft().se2("r0", ORIGIN).between_se2("r0", "q7", (1, 0, 0), sigmas=SIGMAS)


def no_value() -> Draft:
    return Draft().se2("r0", ORIGIN, fixed=True).se2("r1").range_between_se2(HERE, "r1", 1.0, sigmas=0.1)


def too_far() -> Draft:
    return Draft().se2("r0", (1e300, 0, 0)).prior_se2("r0", ORIGIN, sigmas=SIGMAS)


REFUSED: dict[Callable[[], Draft], type[errors.SolverError]] = {
    free_pair: errors.Underconstrained,
    many_free: errors.Underconstrained,
    one_range: errors.Underconstrained,
    one_range_of_an_own_kind: errors.Underconstrained,
    held_in_two_of_three: errors.Underconstrained,
    held_with_one_that_is_not: errors.Underconstrained,
    there_already: errors.DuplicateVariable,
    unknown_end: errors.UnknownVariable,
    no_value: errors.Uninitialized,
    too_far: errors.OutOfBounds,
}
FEW = [draft for draft in REFUSED if draft is not many_free]


def tell(solver: Solver, batch: Batch) -> dict[str, object]:
    solver.stage(batch)
    return solver.step().as_dict()


def told_of(solver: Solver) -> dict[int, bytes]:
    groups = [(group.keys.tolist(), group.values) for group in solver.estimate()]
    return {key: row.tobytes() for keys, values in groups for key, row in zip(keys, values, strict=True)}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("refused", REFUSED, ids=lambda draft: draft.__name__)
def test_a_refused_insert_leaves_the_state_as_it_was(refused: Callable[[], Draft], mode: str) -> None:
    tried, spared = Solver(Options(mode=mode)), Solver(Options(mode=mode))
    for n, batch in enumerate([here().batch(), *islice(random_steps(7), 8)]):
        assert tell(tried, batch) == tell(spared, batch)
        before = flattened(tried.dump())
        with pytest.raises(REFUSED[refused]):
            tell(tried, refused().batch())
        assert flattened(tried.dump()) == before, n
    assert flattened(tried.dump()).keys() == flattened(spared.dump()).keys()


@pytest.mark.parametrize("mode", MODES[1:])
def test_so_does_one_that_its_loss_sets_aside(mode: str) -> None:
    """Which is known only when it is in Λ: its factor determines the pose.  The tree has it rest."""
    solver = Solver(Options(mode=mode, initialize_locally=False))
    for batch in [here().batch(), *islice(random_steps(8), 5)]:
        tell(solver, batch)
        before = flattened(solver.dump())
        with pytest.raises(errors.Underconstrained):
            tell(solver, set_aside_by_its_loss().batch())
        assert flattened(solver.dump()) == before


@pytest.mark.parametrize("mode", MODES)
@examples(8)
@given(
    seed=st.integers(0, 2**32 - 1),
    cameras=st.booleans(),
    tries=st.lists(st.lists(st.sampled_from(FEW), max_size=2), min_size=6, max_size=6),
)
def test_a_map_goes_on_as_if_nothing_had_been_refused(
    mode: str, seed: int, cameras: bool, tries: list[list[Callable[[], Draft]]]
) -> None:
    tried, spared = Solver(Options(mode=mode)), Solver(Options(mode=mode))
    drive = camera_steps(seed, 6, loss="huber") if cameras else random_steps(seed, 6)
    for batch, refused in zip([here().batch(), *drive], [[], *tries], strict=False):
        for draft in refused:
            before = flattened(tried.dump())
            with pytest.raises(REFUSED[draft]):
                tell(tried, draft().batch())
            assert flattened(tried.dump()) == before
        assert tell(tried, batch) == tell(spared, batch)
    assert told_of(tried) == told_of(spared)


AHEAD = [1.0, 0.0, 0.0]
UNHELD = {
    "an end that is not there": Batch(factors=(between(2, 99, AHEAD),)),
    "a pair that nothing holds": Batch(
        (Variables("se2", np.array([50, 60]), np.zeros((2, 3))),), (between(50, 60, AHEAD),)
    ),
    "a fixed pose, and an end that is not there": Batch(
        (Variables("se2", np.array([70]), np.zeros((1, 3)), True),), (between(70, 99, AHEAD),)
    ),
}


@pytest.mark.parametrize("content", UNHELD.values(), ids=UNHELD)
def test_nor_does_it_in_what_hangs_together_where_closures_are_tested(content: Batch) -> None:
    made = TestedMap()
    for batch in corridor(4):
        made.insert(batch)
    before = flattened(made.solver.dump())
    assert isinstance(made.insert(content)[0], errors.SolverError)
    assert flattened(made.solver.dump()) == before
