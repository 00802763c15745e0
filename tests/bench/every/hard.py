"""Steps that turn much of a map: loops that drifted, robots that meet, positions that come late, wrong closures.

Each world is a function of (poses, seed) and gives a batch a step.  What is drawn, is drawn from the seed: where and
when the step comes, by how much it turns, and how weak the prior is that it turns against.
"""

from collections.abc import Iterator

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.simulate import WORLDS

from .motion import SPACE, Motion, between, factor

X = symbol("x", 0)
B = X + 1_000_000  # the poses of a second robot
_WRONG = 0.05  # of all closures, in `outliers`
_CLOSURE_SIGMAS = (0.1, 0.1, 0.05)


def drift(poses: int, seed: int) -> Iterator[Batch]:
    """A round whose heading drifts by 60° to 180°, and then one loop closure, in a step of its own."""
    alpha = np.radians(np.random.default_rng([seed, 11]).uniform(60.0, 180.0))
    z = np.array([1.0, 0.0, (2 * np.pi + alpha) / (poses - 1)])
    yield Batch((Variables("se2", np.array([X]), np.zeros((1, 3)), True),))
    for i in range(1, poses):
        edge = between("between_se2", X + i - 1, X + i, z, (0.05, 0.05, 0.03))
        yield Batch((Variables("se2", np.array([X + i])),), (edge,))
    yield Batch((), (between("between_se2", X + poses - 1, X, np.zeros(3), _CLOSURE_SIGMAS),))


def meetings(motion: Motion, poses: int, seed: int) -> Iterator[Batch]:
    """Two robots in turn, of half the poses each; b believes that it starts where a did, but is 10 to 21 m off and
    turned by 90° to 178°.  Somewhere in the second quarter they first see each other, and from then on now and then.

    That b starts there is a prior of σ 10 m and 1 rad, or a hundred times as much.
    """
    chance = np.random.default_rng([seed, 12])
    half, weakness = poses // 2, float(chance.choice([1.0, 100.0]))
    meet = int(chance.integers(half // 4, half // 2 + 1))
    a = motion.walk(chance, half)
    b = motion.carried(motion.far(chance, 10.0, 21.0, 90.0, 178.0), motion.walk(chance, half))
    weak = tuple(weakness * sigma for sigma in motion.weak)
    for i in range(half):
        yield motion.pose(chance, X, i, a)
        batch = motion.pose(chance, B, i, b, prior=weak)
        if i == meet or (i > meet and chance.random() < 0.2):
            seen = between(motion.between, X + i, B + i, motion.measured(chance, a[i], b[i]), motion.sigmas)
            batch = Batch(batch.variables, (*batch.factors, seen))
        yield batch


def late_positions(motion: Motion, poses: int, seed: int) -> Iterator[Batch]:
    """A drive whose prior is weak, and wrong by 90° to 170° and 10 to 21 m, as positions of σ 0.1 m tell from a pose
    between the 30th and the middle on: at every pose, every fifth, or every tenth."""
    chance = np.random.default_rng([seed, 13])
    first = int(chance.integers(30, max(poses // 2, 31)))
    period, weakness = int(chance.choice([1, 5, 10])), float(chance.choice([1.0, 100.0]))
    truth = motion.carried(motion.far(chance, 10.0, 21.0, 90.0, 170.0), motion.walk(chance, poses))
    weak = tuple(weakness * sigma for sigma in motion.weak)
    size = 3 if motion is SPACE else 2
    for i in range(poses):
        batch = motion.pose(chance, X, i, truth, prior=weak)
        if i >= first and (i - first) % period == 0:
            z = np.concatenate([truth[i, :size] + chance.normal(size=size) * 0.1, np.zeros(size)])
            seen = factor(motion.position, [X + i], z, (0.1,) * size)
            batch = Batch(batch.variables, (*batch.factors, seen))
        yield batch


def outliers(poses: int, seed: int) -> Iterator[Batch]:
    """`manhattan` whose closures have Huber's loss, and of which one in twenty is of another place."""
    chance = np.random.default_rng([seed, 14])
    for step in WORLDS["manhattan"](poses, seed):
        groups = []
        for group in step.batch.factors:
            closes = group.keys[:, 1] - group.keys[:, 0] > 1
            groups.append(_rows(group, ~closes))
            wrong = closes & (chance.random(len(closes)) < _WRONG)
            measured = group.measured.copy()
            measured[wrong] = chance.uniform([-5.0, -5.0, -np.pi], [5.0, 5.0, np.pi], (wrong.sum(), 3))
            robust = _rows(group._replace(measured=measured), closes)
            groups.append(robust._replace(loss="huber", scale=np.full(len(robust.keys), 1.345)))
        yield Batch(step.batch.variables, tuple(group for group in groups if len(group.keys)))


def _rows(group: Factors, picked: np.ndarray) -> Factors:
    keys, measured, information = group.keys[picked], group.measured[picked], group.information[picked]
    return Factors(group.kind, keys, measured, information)
