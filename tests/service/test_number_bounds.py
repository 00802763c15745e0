"""Whatever is admitted, a map never holds a number that is not finite, and what would lead there is refused by name."""

import math
import random
import warnings
from collections import Counter
from typing import Any

import numpy as np
import pytest
from busless import Map
from naive.random_extremes import Extremes

from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.service.core.events import Stepped, Verdict
from factorbus.service.questions.answers import Question

POINT = symbol("l", 0)
MODES = ("bayes-tree", "inc-l", "all-batch")
# What an insert within its bounds may be refused for.
REASONS = {"accepted", "diverged", "not_finite", "underconstrained", "uninitialized", "out_of_bounds",
           "bad_observation", "bad_direction", "not_positive_definite", "bad_range"}  # fmt: skip


def fuzz(mode: str, seed: int, inserts: int) -> Counter[str]:
    """One map with these inserts; how they were answered."""
    rng = np.random.default_rng(seed)
    world, tried, codes = Extremes(rng), Map(mode), Counter[str]()
    batch = world.begin()
    assert tried.insert(batch) == "accepted"
    world.accept(batch)
    for _ in range(inserts):
        batch, before = world.next(), dict(tried.values)
        code = tried.insert(batch, settle=bool(rng.random() < 0.2))
        codes[code] += 1
        assert code in REASONS, f"seed {seed}"
        assert math.isfinite(tried.map_solver.chi2()), f"seed {seed}"
        if code == "accepted":
            world.accept(batch)
        else:
            assert tried.values.keys() == before.keys()
    return codes


@pytest.mark.parametrize("mode", MODES)
def test_admissible_extremes_never_poison_a_map(mode: str, record_property: Any) -> None:
    first = random.randrange(2**32)
    print("seeds from", first)
    codes = Counter[str]()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for seed in range(first, first + 30):  # and others in the next run
            codes += fuzz(mode, seed, 25)
    record_property("codes", dict(codes))
    assert codes["accepted"] > 50, codes


def start(mode: str) -> Map:
    """A point that is weakly known."""
    made = Map(mode)
    prior = Factors("prior_point2", np.array([[POINT]]), np.zeros((1, 2)), np.array([[1e-9, 0, 1e-9]]))
    assert made.insert(Batch((Variables("point2", np.array([POINT]), np.zeros((1, 2))),), (prior,))) == "accepted"
    return made


def far(b: float) -> Batch:
    """What puts the point at −b · 10⁵."""
    measured = np.array([[0, 0, 1e-5, 0, 0, 1e-5, b, 0]])
    return Batch((), (Factors("linear_2_point2", np.array([[POINT]]), measured, np.array([[1e15, 0, 1e15]])),))


def near(x: float) -> Batch:
    return Batch((), (Factors("prior_point2", np.array([[POINT]]), np.array([[x, 0.0]]), np.array([[1.0, 0, 1.0]])),))


@pytest.mark.parametrize("mode", MODES)
def test_a_step_that_diverges_from_unusual_numbers_leaves_every_bit(mode: str) -> None:
    tried, other = start(mode), start(mode)
    before, revision = tried.estimate(), tried.map_solver.revision
    assert tried.insert(far(1e9)) == "diverged"  # beyond 1e8 it is tried on a copy
    assert (tried.estimate(), tried.map_solver.revision) == (before, revision)
    for x in (1.0, 2.0):
        assert (tried.insert(near(x)), other.insert(near(x))) == ("accepted", "accepted")
        assert tried.estimate() == other.estimate()
    assert tried.map_solver.chi2() == other.map_solver.chi2()


@pytest.mark.parametrize("mode", MODES)
def test_a_step_that_diverges_from_usual_numbers_is_undone(mode: str) -> None:
    tried = start(mode)
    before = tried.estimate()
    assert tried.insert(far(9e7)) == "diverged"
    assert tried.values[POINT].tolist() == [0.0, 0.0]
    assert tried.estimate() == before
    assert tried.insert(near(1.0)) == "accepted"
    np.testing.assert_allclose(tried.values[POINT], [1.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_of_several_inserts_only_the_guilty_is_refused(mode: str) -> None:
    tried = start(mode)
    arrived = [tried.arrived(batch) for batch in (near(1.0), far(9e7), near(3.0))]
    events, _ = tried.map_solver.apply_whole(arrived)
    answers = [o.answer for e in events if isinstance(e, Verdict) for o in e.outcomes]
    assert [getattr(answer, "code", "accepted") for answer in answers] == ["accepted", "diverged", "accepted"]
    estimate = tried.map_solver.snapshot([Question("estimate")]).variables[0].values
    np.testing.assert_allclose(estimate, [[2.0, 0.0]], atol=1e-6)


def test_changes_have_the_same_bounds_and_undo_what_was_far() -> None:
    tried = start("bayes-tree")
    assert tried.insert(near(1.0)) == "accepted"
    ids = np.array([1])

    def change(name: str, **more: object) -> str:
        return tried.insert(Batch(), (Change(name, **more),))  # type: ignore[arg-type]

    assert change("weigh", factors=ids, weight=np.array([1e25])) == "bad_weight"
    assert change("weigh", factors=ids, weight=np.array([1e-25])) == "bad_weight"
    assert change("loss", factors=ids, loss="huber", scale=np.array([1e13])) == "bad_loss"
    place = {"kind": "point2", "keys": np.array([POINT])}
    assert change("place", **place, values=np.array([[1e13, 0.0]])) == "out_of_bounds"
    assert change("place", **place, values=np.array([[np.nan, 0.0]])) == "not_finite"
    assert change("weigh", factors=ids, weight=np.array([1e12])) == "accepted"
    assert change("remove_factors", factors=ids) == "accepted"
    np.testing.assert_allclose(tried.values[POINT], [0.0, 0.0], atol=1e-6)


def test_the_reported_case_is_refused_by_name() -> None:
    tried = Map("bayes-tree")
    x0 = Variables("se2", np.array([symbol("x", 0)]), np.zeros((1, 3)), fixed=True)
    assert tried.insert(Batch((x0,))) == "accepted"
    ends = np.array([[symbol("x", 0), POINT]])
    batch = Batch(
        (Variables("point2", np.array([POINT]), np.array([[-0.248, 1.8557e124]])),),
        (
            Factors("bearing_range_se2", ends, np.array([[-0.3937, 1.4403]]), np.array([[3.3608, 1.4943, 7.8659]])),
            Factors("range_se2", ends, np.array([[0.48218]]), np.array([[0.04454]])),
        ),
    )
    assert tried.insert(batch) == "out_of_bounds"
    assert tried.map_solver.size == (1, 0)


@pytest.mark.parametrize("mode", MODES)
def test_run_again_from_a_journal_it_comes_to_the_same_bits(mode: str) -> None:
    tried, again = start(mode), start(mode)
    arrived = [tried.arrived(batch) for batch in (near(1.0), far(9e7), near(3.0), far(1e9), near(2.0))]
    for one in arrived:
        events, _ = tried.map_solver.apply_whole([one])
        assert not any(event.rebuilt for event in events if isinstance(event, Stepped)), "no fault of the solver"
        list(again.map_solver.apply_again([one], rebuilt=False))
        assert (tried.map_solver.revision, tried.map_solver.size) == (again.map_solver.revision, again.map_solver.size)
        assert tried.estimate() == again.estimate()
    assert tried.map_solver.size == (1, 4)


def identity(size: int) -> np.ndarray:
    """An information matrix as it is sent, of one factor."""
    return np.eye(size)[np.triu_indices(size)][None]


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("metres", [500.0, -500.0])
def test_a_step_that_leaves_a_scale_of_nothing_is_refused(mode: str, metres: float) -> None:
    """A prior whose error along x goes with that of ln s, and a position that is far off along x: s = exp(∓450)."""
    tried, s0 = Map(mode), symbol("s", 0)
    origin = np.array([[0, 0, 0, 0, 0, 0, 1, 1]], float)
    similar = Variables("sim3", np.array([s0]), origin)
    joined = np.eye(7)
    joined[0, 6] = joined[6, 0] = 0.9
    prior = Factors("prior_sim3", np.array([[s0]]), origin, joined[np.triu_indices(7)][None])
    assert tried.insert(Batch((similar,), (prior,))) == "accepted"
    before = tried.estimate()
    there = Factors("position_sim3", np.array([[s0]]), np.array([[metres, 0, 0]]), 1e6 * identity(3))
    assert tried.insert(Batch((), (there,))) == "diverged"
    assert tried.estimate() == before
    assert tried.insert(Batch((), (prior,))) == "accepted"


@pytest.mark.parametrize("model", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("least", [5e-324, -5e-324, 1e-300, -1e-160])
def test_a_lens_with_a_distortion_of_next_to_nothing_is_one_without(model: float, least: float) -> None:
    def added(last: float) -> tuple[str, float]:
        """Code of the answer, and χ²."""
        tried, x0 = Map("bayes-tree"), symbol("x", 0)
        pose = Variables("se3", np.array([x0]), np.array([[0, 0, 0, 0, 0, 0, 1]], float), fixed=True)
        place = np.array([[0.1, 0.2, 2.0]])
        point = Variables("point3", np.array([POINT]), place)
        more = [0.01, 0.01, -0.1, last, 0.0] if model == 0.0 else [-0.1, last if model == 2.0 else 0.0, 0, 0, last]
        lens = [model, 500.0, 500.0, 320.0, 240.0, 0.0, *more]
        seen = Factors("point_seen", np.array([[x0, POINT]]), np.array([[345.0, 290.0, *lens]]), identity(2))
        prior = Factors("prior_point3", np.array([[POINT]]), place, identity(3))
        return tried.insert(Batch((pose, point), (seen, prior))), tried.map_solver.chi2()

    assert added(least) == added(0.0)
