"""A beacon that a whole drive has ranges to is eliminated late, MATH §9.4: else it joins all poses that are brought
near the root, and R fills."""

from collections.abc import Iterator

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Options, Solver

BEACONS = np.array([[-6.0, -4.0], [26.0, -5.0], [24.0, 24.0], [-7.0, 23.0]])
FIRST_BEACON = 1 << 20
ENTER = (120, 162, 204, 246)  # poses from which on the beacons are there
SIGMA = np.array([0.03, 0.03, 0.04])


def drive(poses: int, seed: int) -> Iterator[Batch]:
    """Back and forth over a lawn of 20 m, a range to one of four beacons every other pose.

    The ranges to a beacon wait until it can be placed; it enters with all of them, as a range-only front end has it.
    """
    rng = np.random.default_rng(seed)
    truth = np.array([_on_the_lawn(n) for n in range(poses)])
    waiting: list[list[Factors]] = [[] for _ in BEACONS]
    for n in range(poses):
        variables, factors = [Variables("se2", np.array([n]), truth[:1] if n == 0 else None, n == 0)], []
        if n > 0:
            z = _between(truth[n - 1], truth[n]) + rng.normal(0, SIGMA)
            information = np.diag(1 / SIGMA**2)[np.triu_indices(3)]
            factors.append(Factors("between_se2", np.array([[n - 1, n]]), z[None], information[None]))
        beacon = n // 2 % len(BEACONS)
        if n % 2 == 0:
            z = np.linalg.norm(truth[n, :2] - BEACONS[beacon]) + rng.normal(0, 0.1)
            keys = np.array([[n, FIRST_BEACON + beacon]])
            waiting[beacon].append(Factors("range_se2", keys, np.array([[z]]), np.array([[100.0]])))
        if n % 2 == 0 and n >= ENTER[beacon]:
            if n - 2 * len(BEACONS) < ENTER[beacon]:
                place = BEACONS[[beacon]] + rng.normal(0, 0.3, (1, 2))
                variables.append(Variables("point2", np.array([FIRST_BEACON + beacon]), place))
            factors += waiting[beacon]
            waiting[beacon].clear()
        yield Batch(tuple(variables), tuple(factors))


def _on_the_lawn(n: int) -> tuple[float, float, float]:
    row, along = divmod(n, 40)
    forth = row % 2 == 0
    return (along * 0.5 if forth else 20 - along * 0.5), row % 20 * 1.0, 0.0 if forth else np.pi


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    d = b[:2] - a[:2]
    return np.array([c * d[0] + s * d[1], c * d[1] - s * d[0], (b[2] - a[2] + np.pi) % (2 * np.pi) - np.pi])


def test_beacons_that_all_poses_see_do_not_fill_the_factor() -> None:
    solver, fresh = Solver(Options()), Solver(Options(mode="all-batch"))
    relinearized = 0
    for batch in drive(700, 3):
        solver.stage(batch)
        report = solver.step()
        relinearized += report.relinearized
        fresh.stage(batch)
    anew = fresh.step()
    assert relinearized > 10_000
    assert report.nnz_r < 2 * anew.nnz_r
    assert abs(report.chi2 / anew.chi2 - 1) < 1e-3
