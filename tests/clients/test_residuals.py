"""Residuals for colouring: those of the dense twins, and in sum those of the solver."""

from collections.abc import Iterator

import numpy as np
import pytest
from naive.dense_factors import residual
from naive.random_derived import calibration_steps
from naive.random_graphs import random_steps
from naive.random_mounts import mount_steps
from naive.random_others import other_steps
from naive.random_similar import similar_steps

from factorbus.cli.driving.columns import merged
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver
from factorbus.viz.residuals import Values, chi2_of_factors


def sensor_steps(seed: int) -> Iterator[Batch]:
    """What sensors see whose mount is estimated, but for what has a lens."""
    for batch in mount_steps(seed):
        yield Batch(batch.variables, tuple(group for group in batch.factors if group.kind != "point_seen_mount"))


def calibrated_steps(seed: int) -> Iterator[Batch]:
    """Biases, scales, other frames, lever arms and offsets of clocks, but for what has a lens."""
    for batch in calibration_steps(seed):
        yield Batch(batch.variables, tuple(group for group in batch.factors if group.kind != "point_seen_offset"))


def gravity_steps(seed: int) -> Iterator[Batch]:
    """How long gravity is, which is a variable."""
    rng, keys = np.random.default_rng(seed), np.arange(4)
    lengths = Factors("length_vector3", keys[:, None], rng.uniform(9.7, 9.9, (4, 1)), np.full((4, 1), 400.0))
    linear = np.hstack([np.zeros((4, 3)), np.tile(np.eye(3).ravel(), (4, 1)), rng.normal(0, 9, (4, 3))])
    held = Factors("linear_3_vector3", keys[:, None], linear, np.tile([1.0, 0, 0, 1, 0, 1], (4, 1)))
    yield Batch((Variables("vector3", keys, rng.normal(0, 5, (4, 3))),), (lengths, held))


WORLDS = [
    (random_steps, 1),
    (random_steps, 2),
    (random_steps, 3),
    (other_steps, 1),
    (other_steps, 2),
    (sensor_steps, 1),
    (calibrated_steps, 1),
    (similar_steps, 1),
    (gravity_steps, 1),
]


@pytest.mark.parametrize(("steps", "seed"), WORLDS)
def test_every_kind_agrees_with_its_dense_twin_and_the_sum_with_the_solver(steps, seed: int) -> None:
    graph = merged(steps(seed))
    solver = Solver(Options())
    solver.stage(graph)
    report = solver.step(settle=True)
    variables = [Variables(g.kind, g.keys, g.values) for g in solver.estimate()]
    size = {g.kind: VARIABLE_KINDS[g.kind].size for g in variables}
    known = {k: v[: size[g.kind]] for g in variables for k, v in zip(g.keys.tolist(), g.values, strict=True)}
    values, total = Values(variables), 0.0
    for group in graph.factors:
        found = chi2_of_factors(group, values)
        assert np.isfinite(found).all(), group.kind
        total += float(found.sum())
        for keys, z, triangle, chi2 in zip(
            group.keys.tolist(), group.measured, group.information, found.tolist(), strict=True
        ):
            r = residual(group.kind, [known[key] for key in keys], z)
            omega = np.zeros((len(r), len(r)))
            omega[np.triu_indices(len(r))] = triangle
            omega = omega + np.triu(omega, 1).T
            assert chi2 == pytest.approx(r @ omega @ r, rel=1e-9, abs=1e-12)
    assert total == pytest.approx(report.chi2, rel=1e-9)


def test_the_graphs_above_have_every_kind_but_observations() -> None:
    kinds = {group.kind for steps, seed in WORLDS for step in steps(seed) for group in step.factors}
    lenses = {name for name in FACTOR_KINDS if name.startswith(("idp", "point_seen"))}  # more than colours need
    assert {kind for kind in kinds if not FACTOR_KINDS[kind].is_linear} == set(FACTOR_KINDS.keys()) - lenses


def test_what_has_no_value_or_an_unknown_kind_is_nan_and_not_an_error() -> None:
    values = Values([Variables("se2", np.array([7]), np.zeros((1, 3)))])
    missing = Factors("prior_se2", np.array([[7], [8]]), np.ones((2, 3)), np.tile([1.0, 0, 0, 1, 0, 1], (2, 1)))
    assert np.isnan(chi2_of_factors(missing, values)).tolist() == [False, True]
    assert np.isnan(chi2_of_factors(missing._replace(kind="of_tomorrow"), values)).all()
    assert np.isnan(chi2_of_factors(missing, Values([]))).all()
