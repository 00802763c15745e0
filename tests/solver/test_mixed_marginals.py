"""Variables of any kinds marginalized, with poses, points and features in their separator: the rest is what it was."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from naive.dense_factors import pose_matrix, pose_vector
from naive.dense_least_squares import distance
from naive.random_derived import calibration_steps
from naive.random_graphs import camera_steps, random_steps
from naive.random_imu import imu_steps
from naive.random_mounts import mount_steps
from naive.random_others import other_steps
from naive.random_similar import similar_steps
from naive.solver_parts import graph_in, joined_by

from examples import examples
from factorbus.proto.kinds import MOST_JOINED
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.simulate import TreeSensor, city_trees
from factorbus.solver import Options, Solver, errors
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.kernels.model import layout as at

MODES = ("bayes-tree", "inc-l", "all-batch")
WORLDS: dict[str, Callable[[int], Iterator[Batch]]] = {
    "landmarks": lambda seed: random_steps(seed, 8),
    "cameras": lambda seed: camera_steps(seed, 8, noise=0.003),
    "others": lambda seed: other_steps(seed, 6, noise=0.01),
    "mounts": lambda seed: mount_steps(seed, 5, noise=0.01),
    "calibration": lambda seed: calibration_steps(seed, 4, noise=0.01),
    "similarities": lambda seed: similar_steps(seed, 6, noise=0.01),
    "inertial": lambda seed: imu_steps(seed, 6),
}
seeds = st.integers(0, 2**32 - 1)


def solved(world: str, seed: int, mode: str = "bayes-tree") -> Solver:
    solver = Solver(Options(mode=mode))
    for batch in WORLDS[world](seed):
        solver.stage(batch)
        solver.step()
    for _ in range(2):
        solver.step(settle=True)
    return solver


def values(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {k: (g.kind, row) for g in solver.estimate() for k, row in zip(g.keys.tolist(), g.values, strict=True)}


def covariance(solver: Solver, keys: list[int]) -> np.ndarray:
    return CovarianceBlocks(solver.covariances.factored()).joint(np.array([graph_in(solver).find(key) for key in keys]))


def without(solver: Solver, keys: list[int]) -> Solver:
    return with_changes(solver, [Change("marginalize", keys=np.array(keys))], settle=True)[0]


def assert_same(solver: Solver, after: Solver, gone: list[int], settled: float = 1e-9) -> None:
    """What is left is where it was and as certain as it was."""
    before, now = values(solver), values(after)
    assert sorted(now) == sorted(set(before) - set(gone))
    for key, (kind, row) in now.items():
        assert distance(kind, row, before[key][1]) < settled
    free = [key for key in now if graph_in(after).var[graph_in(after).find(key), at.V_COLUMN] >= 0]
    a, b = covariance(solver, free), covariance(after, free)
    sigma = np.sqrt(np.diag(a))
    np.testing.assert_allclose(b / sigma / sigma[:, None], a / sigma / sigma[:, None], rtol=0, atol=1e-8)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("world", WORLDS)
@examples(10)  # of 21 cases, each of some ten solvers
@given(seed=seeds)
def test_any_variables_may_go(world: str, mode: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    solver = solved(world, seed, mode)
    keys = sorted(values(solver))
    gone = [key for key in keys if rng.random() < rng.choice([0.15, 0.4, 0.7])][: len(keys) - 2]
    # How far from the optimum a settled estimate may be: with cameras its standard deviations are about 1.
    settled = 1e-6 if world == "cameras" else 1e-9
    assert_same(solver, without(solver, gone), gone, settled)
    # One after the other it is the same, and what was known of many goes whole into what is known next.
    slowly = solver
    for key in rng.permutation(gone).tolist():
        slowly = without(slowly, [key])
    assert_same(solver, slowly, gone, settled)


def info(*sigmas: float) -> np.ndarray:
    return np.diag(1.0 / np.array(sigmas) ** 2)[np.triu_indices(len(sigmas))][None]


def test_of_a_point_that_is_not_determined_what_is_known_is_kept() -> None:
    """A distance to a pose that goes leaves a point somewhere on a circle; one more distance says where."""
    l, x = symbol("l", 0), symbol("x", 0)
    ends = np.array([[x, l]])
    solver = Solver(Options())
    first = Variables("se2", np.array([x]), np.zeros((1, 3)))
    point = Variables("point2", np.array([l]), np.array([[3.0, 4.0]]))
    solver.stage(
        Batch(
            (first, point, Variables("se2", np.array([x + 1]), np.array([[6.0, 0.0, 0.0]]), fixed=True)),
            (
                Factors("range_se2", ends, np.array([[5.0]]), info(0.1)),
                Factors("prior_se2", ends[:, :1], np.zeros((1, 3)), info(0.1, 0.1, 0.1)),
                Factors("range_se2", ends + np.array([1, 0]), np.array([[5.1]]), info(0.1)),
            ),
        )
    )
    solver.step(settle=True)
    after = without(solver, [x])
    kinds = {group.kind for group in after.graph()[1]}
    assert kinds == {"linear_1_point2", "range_se2"}
    assert_same(solver, after, [x])


def test_a_border_is_bounded_and_a_refusal_says_by_what() -> None:
    """It costs n²/2 blocks; a landmark that everything saw is found out before anything is computed."""
    poses = MOST_JOINED + 1
    keys = np.array([symbol("x", n) for n in range(poses)])
    l = np.array([symbol("l", 0)])
    seen = np.stack([keys, np.repeat(l, poses)], axis=1)
    solver = Solver(Options())
    solver.stage(
        Batch(
            (Variables("se2", keys, np.zeros((poses, 3))), Variables("point2", l, np.ones((1, 2)))),
            (
                Factors("landmark_se2", seen, np.ones((poses, 2)), np.repeat(info(0.1, 0.1), poses, axis=0)),
                Factors("prior_se2", keys[:, None], np.zeros((poses, 3)), np.repeat(info(1, 1, 1), poses, axis=0)),
            ),
        )
    )
    solver.step(settle=True)
    with pytest.raises(errors.TooConnected, match="at most 128") as refused:
        without(solver, [int(l[0])])
    assert refused.value.detail["separator"] == keys.tolist()
    after = without(solver, [int(l[0]), int(keys[0])])
    assert [len(keys) for keys in joined_by(after)] == [MOST_JOINED]
    assert_same(solver, after, [int(l[0]), int(keys[0])])


class Window:
    """Of a drive past trees the last poses, and the trees that they see; the others are marginalized now and then."""

    def __init__(self, keep: int, every: int) -> None:
        self.solver, self.rest = Solver(Options()), Solver(Options())
        self.keep, self.every, self.first = keep, every, 0
        self.names: dict[int, int] = {}  # of trees that are there: the key they go by
        self.seen: dict[int, int] = {}  # the pose that saw each last
        self.sizes: list[int] = []
        self.widest = 0

    def take(self, n: int, batch: Batch) -> None:
        named = self._named(n, batch)
        for solver in (self.solver, self.rest):
            solver.stage(named)
            solver.step()
        if n - self.first == self.keep + self.every:
            self._slide()

    def _named(self, n: int, batch: Batch) -> Batch:
        """A tree that has been let go gets another name when it is seen again."""
        variables, factors = [g for g in batch.variables if g.kind == "se2"], []
        new = []
        for group in batch.factors:
            keys = group.keys.copy()
            for row in keys if group.kind == "landmark_se2" else ():
                tree = int(row[1])
                if tree not in self.names:
                    self.names[tree] = symbol("t", 1000 * n + len(new))
                    new.append(self.names[tree])
                row[1] = self.names[tree]
                self.seen[tree] = n
            factors.append(group._replace(keys=keys))
        trees = [Variables("point2", np.array(new), None)] if new else []
        return Batch((*variables, *trees), tuple(factors))

    def _slide(self) -> None:
        gone = [symbol("x", k) for k in range(self.first, self.first + self.every)]
        self.first += self.every
        for tree in [tree for tree, last in self.seen.items() if last < self.first]:
            gone.append(self.names.pop(tree))
            del self.seen[tree]
        self.solver = with_changes(self.solver, [Change("marginalize", keys=np.array(gone))])[0]
        self.sizes.append(self.solver.memory_bytes())
        self.widest = max(self.widest, *(len(keys) for keys in joined_by(self.solver)), 0)


@pytest.mark.timeout(600)
@pytest.mark.parametrize("poses", [600, pytest.param(3000, marks=pytest.mark.data)])
def test_a_window_past_trees_takes_constant_memory_and_is_where_the_whole_map_has_it(poses: int) -> None:
    window = Window(keep=30, every=10)
    # What was linearized once and for all is off by the square of the noise, which no window can help.
    calm = partial(city_trees, sigma_xy_m=0.006, sigma_theta_rad=0.003, sensor=TreeSensor(sigma_m=0.03, share=0.6))
    for n, step in enumerate(calm(poses, seed=2, tree_share=0.6)):
        window.take(n, step.batch)
    assert window.widest >= 8, "there are trees in the separator"
    half = len(window.sizes) // 2
    assert max(window.sizes[half:]) <= 2.0 * max(window.sizes[:half]), "it does not grow with the length of the drive"
    window.solver.step(settle=True)
    window.rest.step(settle=True)
    here, there = values(window.solver), values(window.rest)
    keys = [key for key in here if key >> 56 == ord("x")]
    last = here[keys[-1]][1], there[keys[-1]][1]
    for key in keys:
        seen, wanted = (relative(of[key][1], end) for of, end in zip((here, there), last, strict=True))
        assert distance("se2", seen, wanted) < 5e-3, "the window is what it is in the whole map"
    if poses < 1000:  # and where it is there, but for what was linearized once
        sigma = np.sqrt(np.diag(covariance(window.rest, keys))).reshape(-1, 3)
        for key, sure in zip(keys, sigma, strict=True):
            apart = here[key][1] - there[key][1]
            apart[2] = np.angle(np.exp(1j * apart[2]))
            assert (np.abs(apart) < 0.1 * sure).all()
        a, b = covariance(window.solver, keys[-1:]), covariance(window.rest, keys[-1:])
        np.testing.assert_allclose(np.sqrt(np.diag(a)), np.sqrt(np.diag(b)), rtol=0.05)


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return pose_vector(np.linalg.inv(pose_matrix(a)) @ pose_matrix(b))
