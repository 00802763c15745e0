"""Poses marginalized beside fixed ones, of which one is freed afterwards."""

import numpy as np
import pytest
from naive.marginal_windows import covariance, loopy, marginalize, relative_pose, x

from factorbus.proto.messages import Batch, Change, Variables
from factorbus.solver import Options, Solver
from factorbus.solver.changing import with_changes


def held(kind: str, fixed: list[int]) -> Solver:
    """A drive of 14 poses with loops, without noise."""
    batch = loopy(kind, 14, 3)
    (poses,) = batch.variables
    assert poses.values is not None
    value = dict(zip(poses.keys.tolist(), poses.values, strict=True))
    factors = tuple(
        f._replace(measured=np.array([relative_pose(kind, value[i], value[j]) for i, j in f.keys.tolist()]))
        for f in batch.factors
        if f.kind == f"between_{kind}"
    )
    is_fixed = np.isin(np.arange(14), fixed)
    variables = [Variables(kind, poses.keys[rows], poses.values[rows], bool(rows is is_fixed))
                 for rows in (is_fixed, ~is_fixed)]  # fmt: skip
    solver = Solver(Options())
    solver.stage(Batch(tuple(variables), factors))
    solver.step(settle=True)
    return solver


@pytest.mark.parametrize("kind", ["se2", "se3"])
def test_what_hung_on_the_one_fixed_pose_is_as_certain_when_another_holds_it(kind: str) -> None:
    solver = held(kind, [5])
    less = with_changes(solver, marginalize(4, 6, 2))[0]
    changes = [Change("fix", keys=x(12)), Change("free", keys=x(5))]
    whole, rest = (covariance(with_changes(each, changes)[0], 0, 1, 5, 7, 13) for each in (solver, less))
    sigma = np.sqrt(np.diag(whole))
    np.testing.assert_allclose(rest / sigma / sigma[:, None], whole / sigma / sigma[:, None], rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", ["se2", "se3"])
def test_of_several_fixed_poses_one_that_is_freed_is_never_more_certain(kind: str) -> None:
    solver = held(kind, [5, 7])
    less = with_changes(solver, marginalize(4, 6))[0]
    freed = [Change("free", keys=x(5))]
    whole, rest = (covariance(with_changes(each, freed)[0], 0, 1, 5, 12) for each in (solver, less))
    sigma = np.sqrt(np.diag(whole))
    more = np.linalg.eigvalsh((rest - whole) / sigma / sigma[:, None])
    assert more.min() > -1e-8
    assert more.max() > 1e-3
