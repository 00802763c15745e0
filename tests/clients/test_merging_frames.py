"""Merging a map that knows where it is in another frame: f ∘ x stays what it is, and so do velocities."""

import numpy as np
import pytest
from naive.dense_factors import TANGENT, jacobians, residual
from naive.dense_least_squares import full
from naive.random_derived import calibration_steps
from naive.random_graphs import random_value

from factorbus.client import Draft
from factorbus.client.frames import moved_values
from factorbus.client.merging import AbsoluteFactors, fit_into
from factorbus.client.roles import Roles, of_the_map, roles_of
from factorbus.client.transform_linear import are_relative, transform_linear
from factorbus.proto.messages import Batch, Estimate, Factors, MapGraph, Variables
from factorbus.proto.roles import poses_aside
from factorbus.proto.symbols import symbol

SPACES = ("se2", "se3")
FRAME, ARM, OFFSET = (symbol(letter, 1) for letter in "fad")


def there(space: str) -> Batch:
    """A drive in one space, of its true values but for rough ones of what is to be found out."""
    seen, variables, factors = set[int](), [], []
    for batch in calibration_steps(3, 4):
        of = [g for g in batch.factors if space in g.kind and not g.kind.startswith("linear")]
        named = {key for g in of for key in g.keys.ravel().tolist()}
        known = np.random.default_rng(len(seen))
        for g in batch.variables:
            if int(g.keys[0]) in named | {FRAME, ARM, OFFSET} and (space in g.kind or g.kind[-1] in ("1", space[-1])):
                values = random_value(g.kind, known)[None] if g.values is None else g.values
                variables.append(g._replace(values=values))
                seen.add(int(g.keys[0]))
        factors += [g for g in of if set(g.keys.ravel().tolist()) <= seen]
    return Batch(tuple(variables), tuple(factors))


def values_of(batch: Batch) -> dict[int, np.ndarray]:
    found = {}
    for g in batch.variables:
        assert g.values is not None
        found |= dict(zip(g.keys.tolist(), g.values, strict=True))
    return found


def chi2_of(batch: Batch, kinds: set[str]) -> float:
    values, total = values_of(batch), 0.0
    for group in batch.factors:
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True):
            if group.kind in kinds:
                r = residual(group.kind, [values[key] for key in keys], z)
                total += float(r @ full(upper) @ r)
    return total


@pytest.mark.parametrize("space", SPACES)
def test_what_is_left_says_in_the_other_map_what_it_said(space: str) -> None:
    """Positions and priors in the map's own frame are left out; those in another frame go along."""
    batch = there(space)
    pose = Variables(space, np.array([symbol("w", 0)]), random_value(space, np.random.default_rng(1))[None])
    frame, x = random_value(space, np.random.default_rng(2)), "x0" if space == "se2" else "y0"
    with pytest.raises(AbsoluteFactors, match="position"):
        fit_into(Estimate(1, 1, (pose,)), MapGraph(1, 1, batch), frame=frame, sigmas=[0.1] * TANGENT[space])
    fitted = fit_into(
        Estimate(1, 1, (pose,)), MapGraph(1, 1, batch), frame=frame, sigmas=[0.1] * TANGENT[space], absolute="leave_out"
    )
    kept = {g.kind for g in fitted.batch.factors}
    assert kept >= {f"position_{space}_frame", f"position_{space}_frame_arm", f"velocity_frame_{space}"}
    assert not kept & {f"position_{space}_arm", f"position_{space}_offset", f"prior_{space}"}
    moved = Batch(fitted.batch.variables, fitted.batch.factors[: -fitted.anchors])
    assert chi2_of(moved, kept) == pytest.approx(chi2_of(batch, kept), rel=1e-9)
    assert symbol("f", int(space == "se3")) in poses_aside(batch)
    assert symbol(x[0], 0) in {int(key) for g in of_the_map(batch) for key in g.keys}


@pytest.mark.parametrize("space", SPACES)
def test_a_linear_factor_with_a_frame_and_a_velocity_moves_with_them(space: str) -> None:
    """The linear models of factors in another frame, before and after: y, H and what they say of the whole map."""
    rng, dim = np.random.default_rng(5), int(space[-1])
    T, vector = random_value(space, rng), f"vector{dim}"
    x, f, v = (random_value(kind, rng) for kind in (space, space, vector))
    roles = Roles(frames=np.array([1]), axes=np.array([2]))
    lever = rng.normal(size=dim)

    def linear(kind: str, keys: list[int], ends: list[np.ndarray], kinds: list[str], z: np.ndarray) -> Factors:
        H, name = jacobians(kind, kinds, ends, z), f"linear_{dim}_{'_'.join(kinds)}"
        measured = np.concatenate([*ends, *(J.ravel() for J in H), residual(kind, ends, z)])
        return Factors(name, np.array([keys]), measured[None], np.zeros((1, 0)))

    x1, f1, v1 = (
        moved_values(kind, value[None], T, role)[0]
        for kind, value, role in ((space, x, ""), (space, f, "frame"), (vector, v, "axes"))
    )
    for kind, keys, kinds, before, after, z in (
        (f"position_{space}_frame", [0, 1], [space, space], [x, f], [x1, f1], np.concatenate([np.zeros(dim), lever])),
        (f"velocity_frame_{space}", [1, 2], [space, vector], [f, v], [f1, v1], np.zeros(dim)),
    ):
        moved = transform_linear(linear(kind, keys, before, kinds, z), T, roles)
        np.testing.assert_allclose(moved.measured, linear(kind, keys, after, kinds, z).measured, atol=1e-6)
        assert are_relative(linear(kind, keys, before, kinds, z), roles).all()
        assert not are_relative(linear(kind, keys, before, kinds, z), Roles()).all()


def test_roles_are_told_by_the_factors() -> None:
    draft = Draft().position_se2("x0", (1, 2), frame="f0", sigmas=(1, 1))
    draft.velocity_frame_se2("f0", "v0", (1, 0), sigmas=(1, 1))
    draft.landmark_se2("x0", "l0", (1, 0), mount="m0", sigmas=(1, 1))
    found = roles_of(draft.batch())
    assert [keys.tolist() for keys in found] == [[symbol(letter, 0)] for letter in "mfv"]
