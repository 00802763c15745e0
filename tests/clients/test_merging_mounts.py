"""Merging a map with mounts of sensors: the map moves, and what is on a robot stays where it is there."""

import numpy as np
import pytest
from naive.dense_factors import residual
from naive.dense_least_squares import full
from naive.random_mounts import CAMERA_MOUNT, SPACE_MOUNT, mount_steps, true_mounts

from factorbus.client import Draft
from factorbus.client.frames import compose
from factorbus.client.merging import fit_into
from factorbus.proto.messages import Batch, Change, Estimate, Factors, MapGraph, Variables
from factorbus.proto.roles import mounts_of
from factorbus.proto.symbols import parse_symbol, symbol
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes

LETTERS = {"y": "z"}


def there(fixed_mount: bool = False) -> MapGraph:
    """A drive in space with a rough mount for each sensor, or one that is known."""
    solver = Solver(Options())
    for batch in mount_steps(3, 5):
        variables = tuple(
            group._replace(fixed=fixed_mount and int(group.keys[0]) == SPACE_MOUNT)
            for group in batch.variables
            if group.kind in ("se3", "point3")
        )
        space = tuple(g for g in batch.factors if "se3" in g.kind or g.kind == "point_seen_mount")
        solver.stage(Batch(variables, space))
        solver.step()
    solver.step(settle=True)
    variables, factors = solver.graph()
    groups = tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in variables)
    return MapGraph(1, 1, Batch(groups, tuple(Factors(g.kind, g.keys, g.measured, g.information) for g in factors)))


def here() -> Estimate:
    pose = Variables("se3", np.array([parse_symbol("x0")]), np.array([[0.0, 0, 0, 0, 0, 0, 1]]))
    return Estimate(1, 1, (pose,))


def chi2_of(batch: Batch) -> float:
    values = {}
    for g in batch.variables:
        assert g.values is not None
        values |= dict(zip(g.keys.tolist(), g.values, strict=True))
    total = 0.0
    for group in batch.factors:
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            r = residual(group.kind, [values[key] for key in keys], z)
            total += r @ full(upper) @ r
    return total


@pytest.mark.parametrize("fixed_mount", [False, True])
def test_mounts_and_what_is_known_of_them_stay(fixed_mount: bool) -> None:
    """The one prior of a pose is only where the map begins; those of mounts are no claims about the map's frame."""
    other = there(fixed_mount)
    frame = np.array([3.0, -2.0, 1.0, 0.5, -0.5, 0.5, 0.5])
    anchor = Draft().between_se3("x0", "z0", compose(frame, pose_of(other.batch)[None])[0], sigmas=[0.1] * 6)
    fitted = fit_into(here(), other, anchors=anchor, letters=LETTERS)
    np.testing.assert_allclose(fitted.frame, frame, atol=1e-9)
    before, after = rows_of(other.batch), rows_of(fitted.batch)
    for key in (SPACE_MOUNT, CAMERA_MOUNT):
        np.testing.assert_array_equal(after[key][0], before[key][0])
        assert after[key][1] == before[key][1] == (fixed_mount and key == SPACE_MOUNT)
    assert set(fitted.left_out) == {"prior_se3"}
    assert fitted.left_out["prior_se3"] == 1
    kept = [g for g in fitted.batch.factors if g.kind == "prior_se3"]
    assert sorted(key for g in kept for key in g.keys[:, 0].tolist()) == sorted([SPACE_MOUNT, CAMERA_MOUNT])
    # Every factor that goes along says what it said.
    stays = Batch(
        other.batch.variables,
        tuple(
            g if g.kind != "prior_se3" else only(g, np.isin(g.keys[:, 0], [SPACE_MOUNT, CAMERA_MOUNT]))
            for g in other.batch.factors
        ),
    )
    moved = Batch(fitted.batch.variables, fitted.batch.factors[: -fitted.anchors])
    assert chi2_of(moved) == pytest.approx(chi2_of(stays), rel=1e-9)


def test_the_mounts_of_a_graph_are_the_last_variables_of_their_factors() -> None:
    assert mounts_of(there().batch).tolist() == sorted(k for k, (kind, _) in true_mounts().items() if kind == "se3")


def only(group: Factors, chosen: np.ndarray) -> Factors:
    return group._replace(
        keys=group.keys[chosen], measured=group.measured[chosen], information=group.information[chosen]
    )


def pose_of(batch: Batch) -> np.ndarray:
    return rows_of(batch)[symbol("y", 0)][0]


def rows_of(batch: Batch) -> dict[int, tuple[np.ndarray, bool]]:
    found = {}
    for g in batch.variables:
        assert g.values is not None
        found |= {key: (row, g.fixed) for key, row in zip(g.keys.tolist(), g.values, strict=True)}
    return found


@pytest.mark.parametrize("absolute", ["leave_out", "keep"])
def test_what_is_known_of_a_mount_together_with_others_goes_along(absolute: str) -> None:
    """Once something is marginalized the mount is in a linear factor with poses, which move while it stays."""
    solver = Solver(Options())
    for batch in mount_steps(3, 5):
        plane = tuple(group for group in batch.variables if group.kind in ("se2", "point2"))
        solver.stage(Batch(plane, tuple(g for g in batch.factors if "se2" in g.kind or g.kind == "prior_point2")))
        solver.step()
    solver.step(settle=True)
    gone = np.array([symbol("l", 0)])
    solver = with_changes(solver, [Change("marginalize", keys=gone)], settle=True)[0]
    variables, factors = solver.graph()
    groups = tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in variables)
    other = MapGraph(1, 1, Batch(groups, tuple(Factors(g.kind, g.keys, g.measured, g.information) for g in factors)))
    pose = Variables("se2", np.array([parse_symbol("w0")]), np.zeros((1, 3)), fixed=True)
    anchor = Draft().between_se2("w0", "x0", (1, 2, 0.5), sigmas=[0.1] * 3)
    fitted = fit_into(Estimate(1, 1, (pose,)), other, anchors=anchor, absolute=absolute)
    target = Solver(Options())
    target.stage(Batch((pose,)))
    target.step()
    target.stage(fitted.batch)
    target.step(settle=True)
    kept = [g for g in fitted.batch.factors if g.kind.startswith("linear")]
    assert [symbol("m", 0) in group.keys for group in kept] == [True]
    assert target.chi2() < 10 * solver.chi2() + 100
