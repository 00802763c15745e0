"""The worlds of `bench every-step`: a seed is a drive, and what turns much of a map does."""

import numpy as np
import pytest
from bench.every.drives import KINDS, WORLDS, chosen

from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver

LATE = ("late_2d", "late_3d", "ranges_2d", "ranges_3d", "frames_2d", "frames_3d")
DRAWN = [name for name, world in WORLDS.items() if world.is_drawn]
SMALL = 60


def steps_of(name: str, poses: int = SMALL, seed: int = 3) -> list[Batch]:
    return list(WORLDS[name].make(poses, seed))


@pytest.mark.parametrize("name", DRAWN)
def test_a_seed_is_a_drive(name: str) -> None:
    first, again, other = (_numbers(steps_of(name, seed=seed)) for seed in (3, 3, 4))
    assert first == again
    assert first != other
    assert sum(batch.variable_count for batch in steps_of(name)) >= SMALL


def _numbers(steps: list[Batch]) -> list[list[float]]:
    return [group.measured.ravel().tolist() for batch in steps for group in batch.factors]


@pytest.mark.parametrize("name", ["meetings_2d", "meetings_3d", "drift", *LATE])
def test_hard_worlds_turn_the_map_by_a_right_angle_or_more(name: str) -> None:
    """Between the estimates before and after some step, where each comes from its own batch.

    A frame and the map that is measured in it may turn by a half each.
    """
    least = np.pi / 4 if name in ("drift", "frames_2d", "frames_3d") else np.pi / 2
    assert _turned(name) > least


def _turned(name: str) -> float:
    """The most that a pose is turned by all steps together, against where it began: of the batches' estimates."""
    solver, most, before = Solver(Options(mode="all-batch")), 0.0, {}
    for batch in steps_of(name):
        for group in batch.variables:
            if group.values is not None:
                before |= dict(zip(group.keys.tolist(), group.values, strict=True))
        solver.stage(batch)
        solver.step(settle=True)
        for group in solver.estimate():
            for key, value in zip(group.keys.tolist(), group.values, strict=True):
                first = before.setdefault(key, value)
                most = max(most, _angle(first, value))
    return most


def _angle(a: np.ndarray, b: np.ndarray) -> float:
    if len(a) == 3:
        return float(abs(np.angle(np.exp(1j * (a[2] - b[2])))))
    return float(2 * np.arccos(min(abs(a[3:] @ b[3:]), 1.0)))


def test_outliers_are_manhattan_s_closures_with_a_loss_and_few_of_them_are_of_another_place() -> None:
    wrong = closures = 0
    for batch, honest in zip(steps_of("outliers", 500), steps_of("manhattan", 500), strict=True):
        measured = np.concatenate([np.empty((0, 3)), *(group.measured for group in batch.factors)])
        true = np.concatenate([np.empty((0, 3)), *(group.measured for group in honest.factors)])
        keys = np.concatenate([np.empty((0, 2), np.int64), *(group.keys for group in batch.factors)])
        assert len(measured) == len(true)
        wrong += int((measured != true).any(axis=1).sum())
        closures += int((keys[:, 1] - keys[:, 0] > 1).sum())
        assert all((group.keys[:, 1] - group.keys[:, 0] > 1).all() for group in batch.factors if group.loss)
        assert all((group.keys[:, 1] - group.keys[:, 0] == 1).all() for group in batch.factors if not group.loss)
    assert 0.01 < wrong / closures < 0.12


@pytest.mark.parametrize("name", LATE)
def test_late_positions_begin_after_thirty_poses(name: str) -> None:
    for seed in range(1, 9):
        kinds = [{group.kind for group in batch.factors} for batch in steps_of(name, 100, seed)]
        first = next(k for k, of in enumerate(kinds) if any(kind.startswith(("position", "range")) for kind in of))
        assert 30 <= first <= 50


@pytest.mark.parametrize("name", ["ranges_2d", "ranges_3d", "frames_2d", "frames_3d"])
def test_no_factor_of_one_variable_tells_where_a_robot_is_but_by_ranges_or_a_frame(name: str) -> None:
    """Priors alone have one variable: of the first pose, and of the frame; anchors are fixed, and at least three."""
    for seed in range(1, 9):
        steps = steps_of(name, 100, seed)
        alone = [group for batch in steps for group in batch.factors if group.keys.shape[1] == 1]
        assert all(group.kind.startswith("prior") for group in alone)
        assert len(alone) <= 2
        anchors = [group for batch in steps for group in batch.variables if group.kind.startswith("point")]
        assert all(group.fixed for group in anchors)
        least = {"ranges_2d": 3, "ranges_3d": 4}.get(name, 0)
        assert sum(len(group.keys) for group in anchors) >= least


def test_worlds_by_name_by_kind_and_all() -> None:
    assert [world.name for world in chosen(["hard"])] == [name for name in DRAWN if WORLDS[name].kind == "hard"]
    assert chosen([]) == list(WORLDS.values())
    assert {world.kind for world in chosen([])} == set(KINDS)
    with pytest.raises(ValueError, match="mars: none of simulated, data, hard, manhattan"):
        chosen(["mars"])
