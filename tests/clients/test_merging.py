"""Merging maps, short of the bus: what is moved measures the same in another frame, what would be wrong is refused."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_derived import is_derived, with_further
from naive.dense_derived import parts_of as modifiers_of
from naive.dense_factors import TANGENT, boxminus, boxplus, pose_matrix, pose_vector, residual
from naive.dense_least_squares import full
from naive.random_camera_factors import random_camera_factor
from naive.random_graphs import random_information, random_value
from naive.random_lenses import LENS_KINDS, random_lens_factor
from naive.random_others import LINEAR, SIMILAR_ENDS, random_other

from factorbus.client import AbsoluteFactors, CannotMerge, Changes, Draft, KeyCollision, NoAnchor
from factorbus.client.frames import compose, difference, inverse, moved_values
from factorbus.client.merging import fit_into
from factorbus.client.roles import Roles
from factorbus.client.transform_factors import transform_factors
from factorbus.client.transform_linear import are_relative
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.linear import parts_of
from factorbus.proto.messages import Batch, Estimate, Factors, MapGraph, Variables
from factorbus.proto.problems import BadSymbol
from factorbus.proto.symbols import parse_symbol
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes

seeds = st.integers(0, 2**32 - 1)
ABSOLUTE = ("prior", "position", "heading", "attitude")
RELATIVE = [name for name in FACTOR_KINDS if not name.startswith(ABSOLUTE) or "frame" in name]
# Of one variable such a factor is absolute.
JOINING = [name for name in LINEAR if len(FACTOR_KINDS[name].connects) > 1]
NO_ROLES = Roles()
SIGMAS = (0.1, 0.1, 0.05)


@given(seed=seeds)
@pytest.mark.parametrize("kind", ["se2", "se3"])
def test_composition_is_that_of_matrices(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_value(kind, rng), random_value(kind, rng)
    A, B = pose_matrix(a), pose_matrix(b)
    np.testing.assert_allclose(pose_matrix(compose(a, b[None])[0]), A @ B, atol=1e-12)
    np.testing.assert_allclose(pose_matrix(inverse(a)), np.linalg.inv(A), atol=1e-12)
    np.testing.assert_allclose(difference(a, b), residual(f"prior_{kind}", [b], a), atol=1e-12)


def random_relative(kind: str, rng: np.random.Generator) -> Any:
    """Values of what a factor of this kind is on, and what is measured."""
    if kind in LENS_KINDS:
        return random_lens_factor(kind, rng, "radtan")
    if is_derived(kind):
        ends, z = random_relative(modifiers_of(kind)[0], rng)
        further = [random_value(of, rng) for of in FACTOR_KINDS[kind].connects[len(ends) :]]
        return [*ends, *further], with_further(kind, z, rng)
    if kind in ("idp_first", "idp_seen", "point_seen"):
        return random_camera_factor(kind, rng)[1:]
    ends = [random_value(of, rng) for of in FACTOR_KINDS[kind].connects]
    if kind.endswith(SIMILAR_ENDS):
        return ends, random_value("point3" if "landmark" in kind else FACTOR_KINDS[kind].connects[0], rng)
    if kind.startswith("between"):
        return ends, random_value(FACTOR_KINDS[kind].connects[0], rng)
    if kind.startswith("landmark"):
        return ends, rng.normal(0, 2, ends[1].size)
    if kind == "bearing_range_se2":
        return ends, np.array([rng.uniform(-3, 3), rng.uniform(1, 5)])
    return ends, random_other(kind, ends, 0.1, rng)


@given(seed=seeds)
@pytest.mark.parametrize("kind", [*RELATIVE, *JOINING])
def test_a_moved_factor_says_of_moved_values_what_it_said_before(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends, z = random_relative(kind, rng)
    connects = FACTOR_KINDS[kind].connects
    T = random_value("se2" if connects[0].endswith("2") else "se3", rng)
    omega = random_information(FACTOR_KINDS[kind].dim, rng)
    group = Factors(kind, np.arange(len(ends))[None], z[None], omega[None])
    moved = transform_factors(group, T, NO_ROLES)
    roles = FACTOR_KINDS[kind].roles or [""] * len(ends)
    ways = zip(connects, ends, roles, strict=True)
    there = [moved_values(of, end[None], T, role)[0] for of, end, role in ways]
    before, after = residual(kind, ends, z), residual(kind, there, moved.measured[0])
    expected = before @ full(omega) @ before
    if kind in JOINING and "idp" in kind:  # directions turn to first order: see below
        return
    np.testing.assert_allclose(after @ full(moved.information[0]) @ after, expected, rtol=1e-7, atol=1e-9)


@given(seed=seeds)
@pytest.mark.parametrize("kind", [kind for kind in JOINING if "idp" in kind])
def test_a_moved_factor_of_features_says_so_to_first_order(kind: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends, z = random_relative(kind, rng)
    connects, T = FACTOR_KINDS[kind].connects, random_value("se3", rng)
    moved = transform_factors(Factors(kind, np.arange(len(ends))[None], z[None], np.zeros((1, 0))), T, NO_ROLES)
    y, far = parts_of(kind, z[None]).y, []
    off = [rng.normal(size=6 if of != "point3" else 3) for of in connects]
    for near in (1e-3, 1e-4):
        at = [boxplus(of, row[0], near * step) for of, row, step in zip(connects, y, off, strict=True)]
        there = [moved_values(of, end[None], T)[0] for of, end in zip(connects, at, strict=True)]
        if any(of == "idp" and np.abs(end[4]) > 1.4 for of, end in zip(connects, there, strict=True)):
            return  # seen along the map's y axis a direction has no azimuth
        far.append(np.abs(residual(kind, at, z) - residual(kind, there, moved.measured[0])).max())
    assert far[1] < 0.02 * far[0] + 1e-9


@pytest.mark.parametrize("kind", JOINING)
def test_what_variables_say_of_each_other_alone_is_distinguished_from_what_they_say_of_the_map(kind: str) -> None:
    """H with rows that a motion of the whole frame leaves alone, by central differences; and such that it does not."""
    rng = np.random.default_rng(3)
    connects = FACTOR_KINDS[kind].connects
    y = [random_value(of, rng) for of in connects]
    G, h = [], 1e-5
    dim = 3 if connects[0] in ("se2", "point2") else 6
    for of, value in zip(connects, y, strict=True):
        columns = []
        for c in range(dim):
            step = h * np.eye(dim)[c]
            nothing = np.zeros(3) if dim == 3 else np.array([0.0, 0, 0, 0, 0, 0, 1])
            both = [
                moved_values(of, value[None], boxplus("se2" if dim == 3 else "se3", nothing, s * step))[0]
                for s in (1, -1)
            ]
            columns.append((boxminus(of, both[0], value) - boxminus(of, both[1], value)) / (2 * h))
        G.append(np.stack(columns, axis=1))
    rows, widths = FACTOR_KINDS[kind].dim, [len(J) for J in G]
    _, _, V = np.linalg.svd(np.concatenate(G).T)
    free = V[dim:] if sum(widths) > dim else np.zeros((1, sum(widths)))
    moves = [of for of in connects if not VARIABLE_KINDS[of].is_vector]
    for relative in (True, False) if moves else (True,):
        H = rng.normal(size=(rows, len(free))) @ free if relative else rng.normal(size=(rows, sum(widths)))
        blocks = np.split(H, np.cumsum(widths)[:-1], axis=1)
        measured = np.concatenate([*y, *(block.ravel() for block in blocks), np.zeros(rows)])
        group = Factors(kind, np.arange(len(y))[None], measured[None], np.zeros((1, 0)))
        assert are_relative(group, NO_ROLES).tolist() == [relative]


def test_a_marginal_of_relative_poses_is_relative_and_one_with_a_prior_is_not() -> None:
    for kind, step in (("se2", (1, 0.2, 0.7)), ("se3", (1, 0.2, 0.1, 0.1, 0.2, 0.3, 0.9))):
        step = (
            np.array(step) if kind == "se2" else np.array([*step[:3], *np.array(step[3:]) / np.linalg.norm(step[3:])])
        )
        sigmas = [0.1, 0.2, 0.3] if kind == "se2" else [0.1, 0.2, 0.3, 0.05, 0.06, 0.07]
        for prior in (False, True):
            draft = Draft().variable(kind, "x0", [0] * 3 if kind == "se2" else [0] * 6 + [1], fixed=True)
            for i in range(1, 5):
                draft.variable(kind, f"x{i}").factor(f"between_{kind}", (f"x{i - 1}", f"x{i}"), step, sigmas=sigmas)
            if prior:
                draft.factor(f"prior_{kind}", ("x2",), draft_pose(kind, step), sigmas=sigmas)
            solver = Solver(Options())
            solver.stage(draft.batch())
            solver.step(settle=True)
            changes = Changes().marginalize("x2").listed()
            marginal, *_ = with_changes(solver, changes, Batch(), True)
            (pair,) = [f for f in marginal.graph()[1] if f.kind.startswith("linear_")]
            rows = TANGENT[kind]
            assert pair.kind == f"linear_{2 * rows if prior else rows}_{kind}_{kind}"
            sent = Factors(pair.kind, pair.keys, pair.measured, pair.information)
            assert are_relative(sent, NO_ROLES).tolist() == [not prior]


def draft_pose(kind: str, step: np.ndarray) -> np.ndarray:
    return pose_vector(pose_matrix(step) @ pose_matrix(step))


def here(*names: str) -> Estimate:
    keys = np.array([parse_symbol(name) for name in names], np.int64)
    rows = np.array([[float(i), 0, 0] for i in range(len(names))])
    return Estimate(7, 1, (Variables("se2", keys, rows),))


def there(*more: Callable[[Draft], Any]) -> MapGraph:
    """x0 and x1, one metre apart along x, and something more."""
    draft = Draft().se2("x0", (0, 0, 0)).se2("x1", (1, 0, 0)).between_se2("x0", "x1", (1, 0, 0), sigmas=SIGMAS)
    for add in more:
        add(draft)
    return MapGraph(9, 4, draft.batch())


LETTERS = {"x": "y"}


def link(z: Any = (0, 2, np.pi / 2), a: str = "x1", b: str = "y0") -> Draft:
    return Draft().between_se2(a, b, z, sigmas=SIGMAS)


def test_values_are_in_the_other_frame_and_keys_have_other_letters() -> None:
    fitted = fit_into(here("x0", "x1"), there(), anchors=link(), letters=LETTERS)
    np.testing.assert_allclose(fitted.frame, (1, 2, np.pi / 2), atol=1e-12)
    (group,) = fitted.batch.variables
    assert group.keys.tolist() == [parse_symbol("y0"), parse_symbol("y1")]
    np.testing.assert_allclose(group.values, [(1, 2, np.pi / 2), (1, 3, np.pi / 2)], atol=1e-12)
    assert [f.keys.tolist() for f in fitted.batch.factors] == [
        [[parse_symbol("y0"), parse_symbol("y1")]],
        [[parse_symbol("x1"), parse_symbol("y0")]],
    ]
    back = fit_into(
        here("x0", "x1"), there(), anchors=link(inverse(np.array([0, 2, np.pi / 2])), "y0", "x1"), letters=LETTERS
    )
    np.testing.assert_allclose(back.frame, fitted.frame, atol=1e-12)


def test_of_several_anchors_a_false_one_does_not_say_where_the_map_begins() -> None:
    anchors = Draft()
    for a, b, z in (("x0", "y1", (9, 9, 2)), ("x0", "y0", (1, 2, 0.5)), ("x1", "y1", (0.87, 2.5, 0.5))):
        anchors.between_se2(a, b, z, sigmas=SIGMAS)
    fitted = fit_into(here("x0", "x1"), there(), anchors=anchors, letters=LETTERS)
    np.testing.assert_allclose(fitted.frame, (1, 2, 0.5), atol=0.1)
    assert fitted.anchors == 3


def test_a_frame_alone_becomes_a_relative_pose_between_what_holds_the_maps() -> None:
    other = there()
    fixed = Variables("se2", np.array([parse_symbol("x5")]), np.array([[3.0, 0, 0]]), True)
    other = MapGraph(9, 4, other.batch._replace(variables=(*other.batch.variables, fixed)))
    fitted = fit_into(here("x0", "x1"), other, frame=(1, 2, np.pi / 2), sigmas=SIGMAS, letters=LETTERS)
    tie = fitted.batch.factors[-1]
    assert tie.keys.tolist() == [[parse_symbol("x0"), parse_symbol("y5")]]
    np.testing.assert_allclose(tie.measured, [(1, 5, np.pi / 2)], atol=1e-12)
    assert fitted.left_out == {"fixed": 1}
    assert not any(group.fixed for group in fitted.batch.variables)


def prior(key: str) -> Callable[[Draft], Any]:
    return lambda draft: draft.prior_se2(key, (0, 0, 0), sigmas=SIGMAS)


def fixed_point(draft: Draft) -> None:
    draft.point2("l1", (0, 0), fixed=True)


@pytest.mark.parametrize(
    ("more", "count"),
    [
        ((), None),
        ((prior("x0"),), None),
        ((prior("x0"), prior("x1")), {"prior_se2": 2}),
        ((lambda d: d.position_se2("x0", (0, 0), sigmas=(1, 1)),), {"position_se2": 1}),
        ((lambda d: d.heading_se2("x0", 0.1, sigmas=(1,)),), {"heading_se2": 1}),
        ((lambda d: d.linear(["x0"], [(0, 0, 0)], [np.eye(3)], np.zeros(3), sigmas=SIGMAS),), {"linear_3_se2": 1}),
        ((fixed_point, prior("x0")), {"fixed": 1, "prior_se2": 1}),
        ((fixed_point,), {"fixed": 1}),
    ],
)
def test_what_a_map_knows_of_its_own_frame_is_refused_unless_it_is_only_where_it_begins(
    more: tuple[Callable[[Draft], Any], ...], count: dict[str, int] | None
) -> None:
    other = there(*more)
    if count is None:
        fitted = fit_into(here("x0", "x1"), other, anchors=link(), letters=LETTERS)
        assert not any(group.kind.startswith(ABSOLUTE) for group in fitted.batch.factors)
        return
    with pytest.raises(AbsoluteFactors) as refused:
        fit_into(here("x0", "x1"), other, anchors=link(), letters=LETTERS)
    assert refused.value.detail == count
    points = any(group.kind == "point2" for group in other.batch.variables)
    letters = {**LETTERS, "l": "m"} if points else LETTERS
    without = fit_into(here("x0", "x1"), other, anchors=link(), letters=letters, absolute="leave_out")
    assert without.left_out == count
    assert without.batch.factor_count == 2
    kept = fit_into(here("x0", "x1"), other, letters=letters, absolute="keep")
    assert kept.batch.factor_count == other.batch.factor_count
    np.testing.assert_array_equal(kept.batch.variables[0].values, other.batch.variables[0].values)
    assert [group.fixed for group in kept.batch.variables] == [group.fixed for group in other.batch.variables]


def test_what_is_known_of_many_poses_is_left_out_whole_or_kept_whole() -> None:
    """What it says of the map's own frame cannot be taken from it."""
    keys = np.array([parse_symbol(f"x{i}") for i in range(3)])
    Lambda = np.kron(3.01 * np.eye(3) - np.ones((3, 3)), np.diag([100.0, 100.0, 400.0]))
    H = np.split(np.linalg.cholesky(Lambda).T, 3, axis=1)
    ends, known = ["x0", "x1", "x2"], {"kinds": ["se2"] * 3, "sigmas": [1.0] * 9}
    sent = Draft().linear(ends, [np.zeros(3)] * 3, H, np.zeros(9), **known).batch().factors
    assert not are_relative(sent[0], NO_ROLES).any()
    batch = there().batch
    other = MapGraph(
        9, 4, Batch((*batch.variables, Variables("se2", keys[2:], np.zeros((1, 3)))), (*batch.factors, *sent))
    )
    fit = partial(fit_into, here("x0", "x1"), other, letters=LETTERS, anchors=link())
    with pytest.raises(AbsoluteFactors):
        fit()
    without = fit(absolute="leave_out")
    assert [group.kind for group in without.batch.factors] == ["between_se2", "between_se2"]
    kept = fit(absolute="keep")
    solver = Solver(Options())
    solver.stage(Batch((Variables("se2", keys[:2], np.zeros((2, 3)), fixed=True),)))
    solver.stage(kept.batch)
    solver.step()
    assert solver.factor_count == kept.batch.factor_count


def test_vectors_stay_as_they_are_and_what_is_known_with_them_goes_along() -> None:
    """A velocity in the robot's frame, a bias: no frame moves them, and a factor on them says nothing of the map."""

    def more(draft: Draft) -> None:
        draft.vector("v0", (0.5, 0, 0.25)).vector("b0", (2.0,))
        draft.linear(["v0"], [(0.5, 0, 0.25)], [np.eye(3)], np.zeros(3), sigmas=(1, 1, 1))
        rows = [np.eye(3), -np.eye(3), 0.5 * np.eye(3), np.ones((3, 1))]
        rows[1], ends = -np.eye(3) @ _adjoint_of_one_metre(), ["x1", "x0", "v0", "b0"]
        draft.linear(ends, [(1, 0, 0), (0, 0, 0), (0.5, 0, 0.25), (2.0,)], rows, np.zeros(3), sigmas=SIGMAS)

    other = there(more)
    fitted = fit_into(here("x0", "x1"), other, anchors=link(), letters={"x": "y", "v": "w", "b": "c"})
    values = {g.kind: g.values for g in fitted.batch.variables}
    np.testing.assert_array_equal(values["vector3"], [[0.5, 0, 0.25]])
    np.testing.assert_array_equal(values["vector1"], [[2.0]])
    assert [g.kind for g in fitted.batch.factors if g.kind.startswith("linear")] == [
        "linear_3_vector3",
        "linear_3_se2_se2_vector3_vector1",
    ]
    assert not fitted.left_out


def _adjoint_of_one_metre() -> np.ndarray:
    """What a displacement of a pose is of the one a metre ahead of it."""
    return np.array([[1.0, 0, 0], [0, 1, 1], [0, 0, 1]])


def test_what_cannot_be_merged_says_why() -> None:
    ours, other = here("x0", "x1"), there()
    for problem, wrong, how in (
        (KeyCollision, other, {"anchors": link()}),
        (KeyCollision, collided(), {"anchors": link(), "letters": LETTERS}),
        (NoAnchor, other, {"letters": LETTERS}),
        (NoAnchor, other, {"letters": LETTERS, "anchors": link(a="x0", b="x1")}),
        (NoAnchor, other, {"letters": LETTERS, "frame": (0, 0, 0)}),
        (CannotMerge, other, {"letters": LETTERS, "frame": (0, 0)}),
        (CannotMerge, other, {"letters": LETTERS, "frame": (0, np.nan, 0)}),
        (CannotMerge, other, {"letters": LETTERS, "absolute": "perhaps"}),
        (CannotMerge, MapGraph(1, 0, Batch()), {"anchors": link()}),
        (CannotMerge, there(lambda d: d.se3("z1", (0, 0, 0, 0, 0, 0, 1))), {"letters": LETTERS, "anchors": link()}),
        (BadSymbol, other, {"letters": {"x": "yy"}, "anchors": link()}),
    ):
        with pytest.raises(problem):
            fit_into(ours, wrong, **how)


def test_an_anchor_on_nothing_and_a_letter_of_nothing_are_named() -> None:
    ours, other = here("x0", "x1"), there()
    with pytest.raises(NoAnchor, match="the anchors name y888, which neither this map has nor the other"):
        fit_into(ours, other, letters=LETTERS, anchors=link(b="y888"))
    with pytest.raises(CannotMerge, match="letters renames 'z', and the other map has no such variables; it has 'x'"):
        fit_into(ours, other, letters={"z": "y"}, anchors=link())


def collided() -> MapGraph:
    """Has y0 already."""
    return there(lambda d: d.se2("y0", (5, 0, 0)).between_se2("x1", "y0", (4, 0, 0), sigmas=SIGMAS))
