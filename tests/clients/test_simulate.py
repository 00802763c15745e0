"""Simulated worlds: the same from the same seed, honest about their noise, and well-formed step by step."""

import itertools
import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest
from counting import count_calls

from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.symbols import format_symbol
from factorbus.simulate import (
    WORLDS,
    BadParameter,
    LoopClosures,
    Spiral,
    Step,
    TreeSensor,
    city_trees,
    inertial,
    manhattan,
    sphere,
)

CASES = {
    "manhattan": lambda poses, seed: manhattan(poses, seed, sigma_xy_m=0.05, sigma_theta_rad=0.1),
    "city_trees": lambda poses, seed: city_trees(poses, seed),
    "city_trees by bearing": lambda poses, seed: city_trees(poses, seed, sensor=TreeSensor("bearing_range_se2")),
    "sphere": lambda poses, seed: sphere(poses, seed, spiral=Spiral(20, 15), sigma_rotation_rad=0.1),
}


def flat(step: Step) -> list:
    """Everything in a step, comparable."""
    groups = [
        (g.kind, g.fixed, g.keys.tolist(), None if g.values is None else g.values.tolist())
        for g in step.batch.variables
    ]
    factors = [(g.kind, g.keys.tolist(), g.measured.tolist(), g.information.tolist()) for g in step.batch.factors]
    return [groups, factors, [(g.kind, g.keys.tolist(), g.values.tolist()) for g in step.truth if g.values is not None]]


@pytest.mark.parametrize("case", CASES)
def test_a_longer_run_begins_with_the_shorter_one(case: str) -> None:
    world = CASES[case]
    short = [flat(step) for step in world(1100, 3)]  # more than one block of poses
    assert len(short) == 1100
    assert short == [flat(step) for step in itertools.islice(world(5000, 3), 1100)]
    assert short[:50] != [flat(step) for step in world(50, 4)]


@pytest.mark.parametrize("case", CASES)
def test_every_step_is_one_pose_that_can_be_composed(case: str) -> None:
    known: set[int] = set()
    for number, step in enumerate(CASES[case](1500, 1)):
        assert {g.kind: g.keys.tolist() for g in step.batch.variables} == {g.kind: g.keys.tolist() for g in step.truth}
        new = [key for group in step.batch.variables for key in group.keys.tolist()]
        assert [name for name in map(format_symbol, new) if name[0] == "x"] == [f"x{number}"]
        for group, truth in zip(step.batch.variables, step.truth, strict=True):
            assert truth.values is not None
            assert truth.values.shape == (len(group.keys), VARIABLE_KINDS[group.kind].size)
            assert group.fixed == (number == 0 and group.kind.startswith("se"))
            assert (group.values is not None) == group.fixed
        if number:
            assert [format_symbol(key) for key in step.batch.factors[0].keys[0].tolist()] == [
                f"x{number - 1}",
                f"x{number}",
            ]
        for group in step.batch.factors:
            facts = FACTOR_KINDS[group.kind]
            assert group.measured.shape == (len(group.keys), facts.size)
            assert group.information.shape == (len(group.keys), facts.information_size)
            for columns in (group.keys, group.measured, group.information):
                assert columns.flags.c_contiguous
            assert (group.keys[:, 0] != group.keys[:, 1]).all()
            assert len({tuple(pair) for pair in group.keys.tolist()}) == len(group.keys)
            assert known.union(new).issuperset(group.keys.ravel().tolist())
        assert known.isdisjoint(new)
        known.update(new)


def residuals(steps: Iterator[Step]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Per kind the residuals (m, r) of all factors at the truth and the diagonals (m, r) of their information."""
    truth: dict[int, np.ndarray] = {}
    found: dict[str, tuple[list, list]] = {}
    for step in steps:
        for group in step.truth:
            assert group.values is not None
            truth.update(zip(group.keys.tolist(), group.values, strict=True))
        for group in step.batch.factors:
            rs, informations = found.setdefault(group.kind, ([], []))
            for (i, j), z, packed in zip(group.keys.tolist(), group.measured, group.information, strict=True):
                rs.append(residual(group.kind, truth[i], truth[j], z))
                full = np.zeros((len(rs[-1]),) * 2)
                full[np.triu_indices(len(full))] = packed
                informations.append(np.diag(full))
                assert (full == np.diag(np.diag(full))).all()
    return {kind: (np.array(rs), np.array(informations)) for kind, (rs, informations) in found.items()}


def residual(kind: str, xi: np.ndarray, xj: np.ndarray, z: np.ndarray) -> np.ndarray:
    """r of one factor, by matrices."""
    if kind == "between_se2":
        r = np.linalg.inv(plane(z)) @ np.linalg.inv(plane(xi)) @ plane(xj)
        return np.array([r[0, 2], r[1, 2], np.arctan2(r[1, 0], r[0, 0])])
    if kind == "between_se3":
        r = np.linalg.inv(space(z)) @ np.linalg.inv(space(xi)) @ space(xj)
        skew = (r[:3, :3] - r[:3, :3].T) / (2 * np.sqrt(1 + np.trace(r[:3, :3])))
        return np.array([*r[:3, 3], skew[2, 1], skew[0, 2], skew[1, 0]])
    seen = (np.linalg.inv(plane(xi)) @ np.array([*xj, 1]))[:2]
    if kind == "landmark_se2":
        return seen - z
    bearing = np.arctan2(seen[1], seen[0]) - z[0]
    return np.array([np.arctan2(np.sin(bearing), np.cos(bearing)), np.hypot(*seen) - z[1]])


def plane(pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0, 0, 1]])


def space(pose: np.ndarray) -> np.ndarray:
    x, y, z, w = pose[3:]
    assert abs(x * x + y * y + z * z + w * w - 1) < 1e-12
    T = np.eye(4)
    T[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    T[:3, 3] = pose[:3]
    return T


@pytest.mark.parametrize("case", CASES)
def test_noise_has_the_covariance_that_is_sent(case: str) -> None:
    """Whitened residuals at the truth are standard normal: each component has mean 0 and variance 1, none depends on
    another, and χ² is the number of components."""
    for kind, (r, information) in residuals(CASES[case](3000, 7)).items():
        white = r * np.sqrt(information)
        count = len(white)
        assert count > 1000
        print(f"{case} {kind}: chi2 {np.sum(white**2):.1f} of {white.size} components")
        assert abs(np.sum(white**2) - white.size) < 5 * np.sqrt(2 * white.size)
        assert (np.abs(white.mean(axis=0)) < 5 / np.sqrt(count)).all()
        assert (np.abs(white.var(axis=0) - 1) < 5 * np.sqrt(2 / count)).all()
        others = np.corrcoef(white.T) - np.eye(white.shape[1])
        assert (np.abs(others) < 5 / np.sqrt(count)).all()
        assert np.mean(np.abs(white) > 2) == pytest.approx(0.0455, abs=5 * np.sqrt(0.0455 / white.size))


def test_loops_of_manhattan_are_what_was_asked_for() -> None:
    places, loops = {}, []
    for step in manhattan(3500, 2, loops=LoopClosures(radius_m=3, gap=60, most=3)):
        number = step.truth[0].keys[0]
        places[int(number)] = step.truth[0].values[0] if step.truth[0].values is not None else None
        if step.batch.factors:
            assert len(step.batch.factors[0].keys) <= 4
            loops += step.batch.factors[0].keys[1:].tolist()
    assert len(loops) > 1000
    assert all(j - i >= 60 for i, j in loops)
    assert max(np.hypot(*(places[i] - places[j])[:2]) for i, j in loops) <= 3
    assert max(j - i for i, j in loops) > 2000  # over most of the drive too
    steps = list(manhattan(300, 2, loops=LoopClosures(share=0)))
    assert sum(step.batch.factor_count for step in steps) == 299


def test_densities_are_those_of_the_data_sets() -> None:
    factors = sum(step.batch.factor_count for step in manhattan())
    assert 5000 < factors < 6500  # manhattan3500: 5598
    observations = sum(len(group.keys) for step in city_trees() for group in step.batch.factors[1:])
    assert 4000 < observations < 8000  # citytrees10000: 4443
    assert sum(step.batch.factor_count for step in sphere()) == 4949  # as sphere2500


def test_trees_are_seen_again() -> None:
    count = {}
    for step in city_trees(3000, 5):
        for group in step.batch.factors[1:]:
            for _, tree in group.keys.tolist():
                count[tree] = count.get(tree, 0) + 1
    assert sorted(count) == list(range(min(count), min(count) + len(count)))  # numbered as they are first seen
    assert np.median(list(count.values())) > 5


def test_sphere_goes_up_and_down_on_its_surface() -> None:
    ring, rings = 12, 6
    steps = list(sphere(2 * ring * rings, 1, spiral=Spiral(ring, rings, radius_m=10), revisit_share=1))
    poses = np.array([step.truth[0].values[0] for step in steps if step.truth[0].values is not None])
    np.testing.assert_allclose(np.linalg.norm(poses[:, :3], axis=1), 10)
    np.testing.assert_allclose(poses[ring * rings :, :3], poses[ring * rings - 1 :: -1, :3], atol=1e-12)
    up = np.array([space(pose)[:3, 2] for pose in poses])
    np.testing.assert_allclose(up, poses[:, :3] / 10, atol=1e-12)
    revisits = [step.batch.factors[0].keys[-1].tolist() for step in steps[ring * rings + ring :]]
    for i, j in revisits:
        np.testing.assert_allclose(poses[i & 0xFFFF, :3], poses[j & 0xFFFF, :3], atol=1e-12)


@pytest.mark.parametrize("name", WORLDS)
def test_a_stream_needs_little_memory_and_its_end_no_more_work_than_its_beginning(name: str) -> None:
    stream = WORLDS[name](9000, 1)
    first, _, last = (count_calls(lambda: [next(stream) for _ in range(3000)]) for _ in range(3))
    assert last < 1.5 * first, "steps do not become dearer with what there is already"
    tracemalloc.start()
    try:
        for step in WORLDS[name](8000, 1):
            assert step.truth
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    print(f"{name}: {peak / 1e6:.1f} MB at most")
    assert peak < 6e6  # all steps together would be some 16 MB


WRONG = [
    (manhattan, {"poses": 0}, "poses is 0; wanted 1 or more"),
    (manhattan, {"seed": -1}, "seed is -1"),
    (manhattan, {"sigma_xy_m": 0.0}, "sigma_xy_m is 0.0; wanted a standard deviation above 0"),
    (manhattan, {"sigma_theta_rad": float("nan")}, "sigma_theta_rad is nan"),
    (manhattan, {"sigma_theta_rad": 2.0}, "up to 0.5"),
    (LoopClosures, {"share": 1.5}, "LoopClosures.share is 1.5; wanted a number from 0 to 1"),
    (LoopClosures, {"most": -1}, "LoopClosures.most is -1"),
    (LoopClosures, {"gap": 1}, "LoopClosures.gap is 1; wanted 2 or more"),
    (LoopClosures, {"radius_m": float("inf")}, "LoopClosures.radius_m is inf"),
    (TreeSensor, {"kind": "radar"}, "TreeSensor.kind is 'radar'; wanted landmark_se2 or bearing_range_se2"),
    (TreeSensor, {"sigma_m": 1.0}, "up to 0.125"),
    (city_trees, {"block_m": 2}, "block_m is 2"),
    (sphere, {"sigma_rotation_rad": 1.0}, "sigma_rotation_rad is 1.0"),
    (Spiral, {"ring": 2}, "Spiral.ring is 2; wanted 3 or more"),
]


@pytest.mark.parametrize(
    ("world", "parameters", "words"), WRONG, ids=lambda part: getattr(part, "__name__", str(part))[:40]
)
def test_parameters_are_checked_before_the_first_step(world, parameters: dict, words: str) -> None:
    with pytest.raises(BadParameter) as caught:
        world(**parameters)
    assert words in str(caught.value)
    assert caught.value.code == "bad_parameter"


@pytest.mark.parametrize("poses", [2, 3, 7, 60])
def test_every_world_has_the_poses_asked_for(poses: int) -> None:
    for name, world in WORLDS.items():
        assert sum(1 for _ in world(poses=poses, seed=1)) == poses, name
    made = inertial(poses, 1)
    assert len(made.odometry) == poses, "an image for each"
    assert made.imu[-1, 0] == made.odometry[-1, 0], "and nothing behind the last"
