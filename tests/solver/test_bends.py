"""What is not looked at could not have mattered: the bound of MATH (9.14) on the slip (9.13)."""

import numpy as np
import pytest
from naive.dense_factors import boxplus
from naive.random_graphs import random_value

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels.tree_bend import LINKS, may_slip, slip_between

_KINDS = {"se2": (at.BETWEEN_SE2, 2, 3, 9 + 9 + 8), "se3": (at.BETWEEN_SE3, 3, 6, 36 + 36 + 35)}


@pytest.mark.parametrize("space", ["se2", "se3"])
def test_a_slip_that_is_not_computed_is_smaller_than_what_it_was_to_be(space: str) -> None:
    kind, axes, dim, turn = _KINDS[space]
    rng, near = np.random.default_rng(7), 0
    for _ in range(3000):
        # 1. Two poses, what one measures of the other, and where both have moved since.
        lin = np.stack([random_value(space, rng) for _ in range(2)])
        size, z = lin.shape[1], random_value(space, rng)[:axes] * rng.choice([0.1, 1.0])
        if rng.random() < 0.5:
            z = _seen(lin, axes) + 0.1 * rng.normal(size=axes)
        moves = rng.normal(size=(2, dim)) * 10.0 ** rng.uniform(-3, 0)
        values = np.stack([boxplus(space, x, move) for x, move in zip(lin, moves, strict=True)])
        # 2. The slip, and what it is held to be at most.
        root, hessian = 10.0 ** rng.uniform(-1, 2), np.zeros(200)
        hessian[turn] = 10.0 ** rng.uniform(-1, 4)
        d = float(np.linalg.norm(z))
        shift = float(np.linalg.norm((values[1] - values[0] - lin[1] + lin[0])[:axes]))
        phi = float(np.linalg.norm(moves[0, axes:]))
        residual = float(np.linalg.norm(_seen(lin, axes) - z))
        slip = slip_between(kind, z, 0, 0, size, root, d, shift, values.ravel(), hessian, 0)
        room = slip * rng.uniform(0.2, 5.0)
        # 3. If it may not come to that, it does not.
        if not may_slip(kind, root, d, phi, shift, residual, hessian[turn], room):
            near += room < 2.0 * slip
            assert slip < room
        assert may_slip(kind, root, d, phi, shift, residual, hessian[turn], 0.0)
    assert near, "no bound was ever close"


def test_only_poses_slip_between_poses() -> None:
    assert not may_slip(at.LANDMARK_SE2, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1e-9)
    assert LINKS > 0.0


def _seen(poses: np.ndarray, axes: int) -> np.ndarray:
    """Rᵢᵀ (tⱼ − tᵢ)"""
    first, gap = poses[0], (poses[1] - poses[0])[:axes]
    if axes == 2:
        c, s = np.cos(first[2]), np.sin(first[2])
        R = np.array([[c, -s], [s, c]])
    else:
        x, y, z, w = first[3:]
        R = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
    return R.T @ gap
