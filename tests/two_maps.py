"""Two robots that drive through one town, each with a map in a frame of its own, and candidates between the maps."""

from typing import NamedTuple

import numpy as np
from naive.dense_factors import boxplus, pose_matrix, pose_vector

from factorbus.client import Draft
from factorbus.client.alignment import CandidatePoses
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks

ODOMETRY = {"se2": np.array([0.05, 0.05, 0.01]), "se3": np.array([0.05] * 3 + [0.01] * 3)}
SEEN = {"se2": np.array([0.1, 0.1, 0.03]), "se3": np.array([0.1] * 3 + [0.03] * 3)}
TOWN_M, NEAR_M, BLOCK_M = 40.0, 4.0, 8.0


class Drive(NamedTuple):
    """truth (n, k, k): where the poses are in the town; steps: what the robot inserts, into a map that begins at 0."""

    truth: np.ndarray
    steps: list[Draft]


class Candidate(NamedTuple):
    """Between pose a of the one drive and b of the other; is_right: which is known here alone."""

    a: int
    b: int
    z: np.ndarray
    is_right: bool


def drive(kind: str, poses: int, rng: np.random.Generator) -> Drive:
    """Along the streets of a town, a metre a step; where the robot has been it closes loops."""
    dim = 2 if kind == "se2" else 3
    place, turn = np.round(rng.uniform(0, TOWN_M, 2) / BLOCK_M) * BLOCK_M, int(rng.integers(4))
    truth, steps = [], []
    for n in range(poses):
        if n and n % int(BLOCK_M) == 0:
            turn += int(rng.integers(-1, 2))
        ahead = np.array([np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)])
        if not ((place + ahead * BLOCK_M >= -1).all() and (place + ahead * BLOCK_M <= TOWN_M + 1).all()) and n % 8 == 0:
            turn += 2
            ahead = -ahead
        place = place + ahead if n else place
        truth.append(_pose(kind, place, turn * np.pi / 2))
        draft = Draft()
        if n == 0:
            steps.append(draft.variable(kind, "x0", pose_vector(np.eye(dim + 1)), fixed=True))
            continue
        draft.variable(kind, f"x{n}")
        for k in (n - 1, *_seen_again(truth, n)):
            sigmas = ODOMETRY[kind] if k == n - 1 else SEEN[kind]
            z = boxplus(kind, pose_vector(np.linalg.inv(truth[k]) @ truth[n]), rng.normal(0, sigmas))
            draft.factor(f"between_{kind}", [f"x{k}", f"x{n}"], z, sigmas=sigmas)
        steps.append(draft)
    return Drive(np.array(truth), steps)


def _pose(kind: str, place: np.ndarray, turn: float) -> np.ndarray:
    if kind == "se2":
        return pose_matrix(np.array([*place, turn]))
    return pose_matrix(np.array([*place, 0.3 * np.sin(place[0] / 9), 0, 0, np.sin(turn / 2), np.cos(turn / 2)]))


def _seen_again(truth: list[np.ndarray], n: int) -> list[int]:
    if n % 4 or n < 20:
        return []
    apart = np.linalg.norm(np.array(truth)[: n - 15, :-1, -1] - truth[n][:-1, -1], axis=1)
    return [int(apart.argmin())] if apart.min() < NEAR_M / 2 else []


def two_drives(
    kind: str, poses: int, counts: tuple[int, int], grouped: int, rng: np.random.Generator
) -> tuple[Drive, Drive, list[Candidate]]:
    """Two robots that were near each other often enough for all these candidates (`candidates_of`)."""
    while True:
        one, other = drive(kind, poses, rng), drive(kind, poses, rng)
        made = candidates_of(kind, one, other, counts, grouped, rng)
        if len(made) == sum(counts) + grouped:
            return one, other, made


def true_frame(one: Drive, other: Drive) -> np.ndarray:
    """T_a_b: each map begins where its robot did."""
    return np.linalg.inv(one.truth[0]) @ other.truth[0]


def candidates_of(
    kind: str, one: Drive, other: Drive, counts: tuple[int, int], grouped: int, rng: np.random.Generator
) -> list[Candidate]:
    """counts: right ones, and false ones anywhere; grouped: false ones that agree, as of two places that look alike.

    Fewer right ones where the two robots were rarely near each other.
    """
    right, wrong = counts
    apart = np.linalg.norm(one.truth[:, None, :-1, -1] - other.truth[None, :, :-1, -1], axis=2)
    near = rng.permutation(np.argwhere(apart < NEAR_M))[:right].tolist()
    made = [Candidate(a, b, _noisy(kind, np.linalg.inv(one.truth[a]) @ other.truth[b], rng), True) for a, b in near]
    for _ in range(wrong):
        a, b = int(rng.integers(len(one.truth))), int(rng.integers(len(other.truth)))
        made.append(Candidate(a, b, _noisy(kind, _anything(kind, rng), rng), False))
    elsewhere = _pose(kind, rng.uniform(-TOWN_M, TOWN_M, 2), rng.uniform(-np.pi, np.pi))
    apart = np.linalg.norm(one.truth[:, None, :-1, -1] - (elsewhere @ other.truth)[None, :, :-1, -1], axis=2)
    close = rng.permutation(np.argwhere(apart < NEAR_M))[:grouped].tolist()
    made += [
        Candidate(a, b, _noisy(kind, np.linalg.inv(one.truth[a]) @ elsewhere @ other.truth[b], rng), False)
        for a, b in close
    ]
    return [made[k] for k in rng.permutation(len(made)).tolist()]


def _anything(kind: str, rng: np.random.Generator) -> np.ndarray:
    return _pose(kind, rng.uniform(-NEAR_M, NEAR_M, 2), rng.uniform(-np.pi, np.pi))


def _noisy(kind: str, T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return boxplus(kind, pose_vector(T), rng.normal(0, SEEN[kind]))


def solved(steps: list[Draft]) -> Solver:
    """The map of a drive."""
    solver = Solver(Options())
    for step in steps:
        solver.stage(step.batch())
        solver.step()
    return solver


def as_matrices(kind: str, one: Solver, other: Solver, candidates: list[Candidate]) -> CandidatePoses:
    """CandidatePoses with the poses and covariances of their maps."""
    (a, known_a), (b, known_b) = (
        _known(solver, [getattr(each, end) for each in candidates]) for solver, end in ((one, "a"), (other, "b"))
    )
    z = np.array([pose_matrix(each.z) for each in candidates])
    noise = np.tile(np.diag(SEEN[kind] ** 2), (len(z), 1, 1))
    return CandidatePoses(a, b, z, noise, known_a, known_b, np.array([(each.a, each.b) for each in candidates]))


def _known(solver: Solver, numbers: list[int]) -> tuple[np.ndarray, np.ndarray]:
    factored = solver.covariances.factored()
    unique, where = np.unique(numbers, return_inverse=True)
    variables = np.array([factored.graph.find(symbol("x", int(k))) for k in unique])
    whole = CovarianceBlocks(factored).joint(variables)
    d = len(whole) // unique.size
    rows = (where[:, None] * d + np.arange(d)).ravel()
    values = {int(key): row for g in solver.estimate() for key, row in zip(g.keys, g.values, strict=True)}
    return np.array([pose_matrix(values[symbol("x", k)]) for k in numbers]), whole[np.ix_(rows, rows)]
