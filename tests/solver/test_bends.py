"""Bounds on what is bent: what is not looked at could not have mattered, MATH (9.14), and when it is due, (9.19)."""

import numpy as np
import pytest
from naive.dense_factors import boxplus
from naive.random_graphs import random_value

from factorbus.solver.kernels import layout as at
from factorbus.solver.kernels import tree_layout as tl
from factorbus.solver.kernels.tree_bend import LINKS, axes_of, may_slip, slip_between
from factorbus.solver.kernels.tree_step import reluctance

_KINDS = {"se2": (at.BETWEEN_SE2, 2, 3), "se3": (at.BETWEEN_SE3, 3, 6)}


@pytest.mark.parametrize("space", ["se2", "se3"])
def test_a_slip_that_is_not_computed_is_smaller_than_what_it_was_to_be(space: str) -> None:
    kind, axes, dim = _KINDS[space]
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
        root, stiff_turn, d = 10.0 ** rng.uniform(-1, 2), 10.0 ** rng.uniform(-1, 4), float(np.linalg.norm(z))
        stiff = np.zeros((1, tl.B_WIDTH))
        stiff[0, [tl.B_LEVER, tl.B_ROOT, tl.B_TURN]] = d, root, stiff_turn
        stiff[0, tl.B_MEASURED : tl.B_MEASURED + axes] = z
        shift = float(np.linalg.norm((values[1] - values[0] - lin[1] + lin[0])[:axes]))
        phi = float(np.linalg.norm(moves[0, axes:]))
        residual = float(np.linalg.norm(_seen(lin, axes) - z))
        planar, flat = space == "se2", values.ravel()
        slip = slip_between(planar, axes_of(planar, 0, flat), 0, size, shift, flat, stiff, 0)
        pull = root * np.linalg.norm(_seen(values, axes) - z)
        assert slip == pytest.approx(LINKS * pull * shift / np.hypot(d, np.sqrt(stiff_turn) / root))
        room = slip * rng.uniform(0.2, 5.0)
        # 3. If it may not come to that, it does not.
        if not may_slip(kind, root, d, phi, shift, residual, stiff_turn, room):
            near += room < 2.0 * slip
            assert slip < room
        assert may_slip(kind, root, d, phi, shift, residual, stiff_turn, 0.0)
    assert near, "no bound was ever close"


def test_only_poses_slip_between_poses() -> None:
    assert not may_slip(at.LANDMARK_SE2, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1e-9)
    assert LINKS > 0.0


def test_so_soon_after_a_relinearisation_more_has_to_be_bent() -> None:
    settings, state = np.zeros(tl.P_SIZE), np.zeros(tl.S_SIZE, np.int64)
    settings[tl.P_REST], settings[tl.P_RELUCTANCE], state[tl.S_RELINEARISED_AT] = 100, 8.0, 1000
    after = {}
    for dear in (1.0, 4.0):  # times what is dear
        settings[tl.P_DEAR] = dear
        for step in (1001, 1035, 1050, 1100, 5000):
            state[tl.S_STEP] = step
            after[dear, step - 1000] = reluctance(settings, state)
    assert [after[1.0, since] for since in (1, 35, 50, 100, 4000)] == [8.0, 8.0, 4.0, 1.0, 1.0]
    assert [after[4.0, since] for since in (1, 35, 50, 100, 4000)] == [16.0, 16.0, 16.0, 16.0, 1.0]


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
