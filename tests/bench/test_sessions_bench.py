"""The bench `sessions`: what it compares, on a small town."""

import numpy as np
from bench import sessions
from bench.town_drives import FrontEnd, key_of, town

from factorbus.solver.lifelong.policy import KeepPolicy


def test_a_way_is_driven_again_beside_itself() -> None:
    of = town(120, 3)
    one, other = of.day(1), of.day(2)
    assert np.array_equal(one, town(120, 3).day(1))
    apart = np.linalg.norm((one - other)[:, :2], axis=1)
    assert 0.0 < apart.min() <= apart.max() < 1.8


def test_closures_are_to_poses_that_are_there() -> None:
    of, front = town(200, 3), FrontEnd(3)
    for k in range(200):
        front.step(1, k, of.day(1))
    front.end_day()
    gone = [key_of(1, k) for k in range(0, 200, 2)]
    front.gone(np.array(gone))
    named = {int(i) for k in range(200) for g in front.step(2, k, of.day(2)).factors for i in g.keys[:, 0]}
    yesterday = {key for key in named if key < key_of(2, 0)}
    assert yesterday
    assert not yesterday & set(gone)


def test_a_small_town_is_within_the_targets_and_one_that_keeps_all_is_not() -> None:
    rows = sessions.medians([sessions.drive(town(200, seed), 3, KeepPolicy(2.0, window=20)) for seed in (1, 2)])
    assert [row["drive"] for row in rows] == [1, 2, 3]
    assert rows[-1]["full_variables"] == 600
    assert rows[-1]["growth"] < 1.2
    assert rows[-1]["worst_ate_ratio"] >= rows[-1]["ate_ratio"]
    assert sessions.met([row | {"step_ms": 1.0} for row in rows])
    assert not sessions.met([row | {"step_ms": 1.0, "growth": 3.0} for row in rows])
    assert not sessions.met([row | {"step_ms": 1.0, "ate_ratio": 1.3} for row in rows])
    assert not sessions.met([row | {"step_ms": float(row["drive"] ** 2)} for row in rows])
