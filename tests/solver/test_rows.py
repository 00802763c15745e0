"""Which variables are of which kind: spans that follow a graph as it grows and forgets, against counting anew."""

import numpy as np
import pytest

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.solver import Solver, errors
from factorbus.solver.graph.rows import Rows
from factorbus.solver.kernels.model import layout as at

UNIT = [1.0, 0.0, 0.0, 1.0, 0.0, 1.0]


def labelled(labels: list[int]) -> np.ndarray:
    """`var` of variables with these labels, three numbers each."""
    var = np.zeros((max(len(labels), 1), at.V_WIDTH), np.int64)
    for v, label in enumerate(labels):
        var[v, at.V_KIND], var[v, at.V_AT], var[v, at.V_COLUMN] = label // 2, 3 * v, -1 if label % 2 else v
    return var


def check(rows: Rows, labels: list[int]) -> None:
    spans = list(rows.follow(labelled(labels), len(labels)))
    found = [(span.label, span.rows().tolist(), span.together) for span in spans]
    wanted = [(label, [v for v, one in enumerate(labels) if one == label]) for label in sorted(set(labels))]
    assert [one[:2] for one in found] == wanted
    for span, (_, there) in zip(spans, wanted, strict=True):
        if there[-1] - there[0] + 1 == len(there):
            assert not span.together or (span.first, span.behind, span.start) == (there[0], there[-1] + 1, 3 * there[0])
        else:
            assert not span.together


@pytest.mark.parametrize("seed", range(30))
def test_spans_are_what_counting_anew_gives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows, labels = Rows(), list[int]()
    kinds = rng.choice(10, rng.integers(1, 4), replace=False)
    for _ in range(40):
        if labels and rng.random() < 0.3:
            del labels[int(rng.integers(0, len(labels) + 1)) :]
            rows.forget(len(labels))
        one = rng.random() < 0.5
        some = rng.choice(kinds[:1] if one else kinds, rng.integers(0, 14 if rng.random() < 0.3 else 3))
        labels += some.tolist()
        if rng.random() < 0.8:
            check(rows, labels)
    check(rows, labels)


def test_a_drive_stays_together_behind_its_fixed_start() -> None:
    rows, labels = Rows(), [1]
    for _ in range(50):
        labels.append(0)
        check(rows, labels)
    assert [span.together for span in rows.follow(labelled(labels), len(labels))] == [True, True]


def posed(first: int, count: int, fixed: bool = False, between: bool = False) -> Batch:
    """Poses in a row from key `first` on, each measured from the one before; between: a point behind each of them."""
    keys = np.arange(first, first + count)
    values = np.stack([keys + 0.1, 0.0 * keys, 0.0 * keys], 1)
    joined = np.stack([keys - 1, keys], 1)[1 if fixed else 0 :]
    odometry = Factors("between_se2", joined, np.tile([1.0, 0, 0], (len(joined), 1)), np.tile(UNIT, (len(joined), 1)))
    poses = Variables("se2", keys, values, fixed)
    if not between:
        return Batch((poses,), (odometry,))
    points = Variables("point2", keys + 1000, values[:, :2] + 1.0)
    seen = Factors(
        "landmark_se2",
        np.stack([keys, keys + 1000], 1),
        np.ones((count, 2)),
        np.tile([1.0, 0.0, 1.0], (count, 1)),
    )
    return Batch((poses, points), (odometry, seen))


@pytest.mark.parametrize("between", [False, True])
def test_keys_that_were_given_stay_when_what_had_them_is_refused(between: bool) -> None:
    solver = Solver()
    solver.stage(posed(0, 1, fixed=True))
    for first in range(1, 600, 4):
        solver.stage(posed(first, 3, between=between))
        solver.step()
        solver.stage(Batch((Variables("se2", np.array([-1]), np.zeros((1, 3))),)))  # nothing holds it
        given = solver.estimate()
        seen = [group.keys.copy() for group in given]
        with pytest.raises(errors.Underconstrained):
            solver.step()
        solver.stage(posed(first + 3, 1))
        solver.step()
        found = np.concatenate([group.keys for group in solver.estimate()])
        wanted = np.concatenate([group.keys for group in solver.graph(solver.variable_count)[0]])
        assert np.array_equal(np.sort(found), np.sort(wanted))
        assert -1 not in found
        assert all(np.array_equal(group.keys, keys) for group, keys in zip(given, seen, strict=True))
        assert not any(group.keys.flags.writeable for group in given)


def test_what_is_done_to_an_estimate_is_not_in_the_next() -> None:
    solver = Solver()
    solver.stage(posed(0, 1, fixed=True))
    solver.stage(posed(1, 5))
    solver.step()
    held, free = sorted(solver.estimate(), key=lambda group: not group.fixed)
    free.values[:] = np.nan
    with pytest.raises(ValueError, match="read-only"):
        held.values[:] = np.nan
    again = sorted(solver.estimate(), key=lambda group: not group.fixed)
    assert all(np.isfinite(group.values).all() for group in again)
    solver.stage(posed(6, 2, fixed=True))
    held = next(group for group in solver.estimate() if group.fixed)
    assert held.keys.tolist() == [0, 6, 7]
    assert held.values[:, 0].tolist() == [0.1, 6.1, 7.1]
    assert not held.values.flags.writeable
