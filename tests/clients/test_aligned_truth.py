"""Ground truth in the frame of an estimate: any rigid motion between them is found, and no reflection."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from factorbus.cli.driving.aligned_truth import aligned_error_m, aligned_truth
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Variables


def turned(rng: np.random.Generator, n: int) -> F64:
    Q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    Q[:, -1] *= np.sign(np.linalg.det(Q))
    return Q


@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(["se2", "se3"]))
def test_a_moved_estimate_has_no_error(seed: int, kind: str) -> None:
    rng = np.random.default_rng(seed)
    n = {"se2": 2, "se3": 3}[kind]
    values = rng.normal(size=(6, {"se2": 3, "se3": 7}[kind]))
    truth = (Variables(kind, np.arange(6), values), Variables(f"point{n}", np.array([9]), values[:1, :n].copy()))
    moved = values.copy()
    R, t = turned(rng, n), rng.normal(size=n)
    moved[:, :n] = values[:, :n] @ R.T + t
    estimate = (Variables(kind, np.arange(1, 7), np.roll(moved, -1, axis=0)),)  # key 6 has no truth
    error = aligned_error_m(truth, estimate)
    assert error is not None
    assert error["poses"] == 5
    assert error["max"] < 1e-10
    _, point = aligned_truth(truth, estimate)
    assert point.values is not None
    np.testing.assert_allclose(point.values[0], moved[0, :n], atol=1e-10)


def test_a_mirrored_estimate_has_an_error_and_what_is_not_in_both_has_none() -> None:
    values = np.array([[0.0, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 1, 0]])
    truth = (Variables("se2", np.arange(4), values),)
    mirrored = (Variables("se2", np.arange(4), values * [-1, 1, 1]),)
    error = aligned_error_m(truth, mirrored)
    assert error is not None
    assert error["max"] > error["rms"] > 1
    assert aligned_error_m(truth, (Variables("se2", np.array([7]), values[:1]),)) is None
    assert aligned_truth(truth, (Variables("se3", np.arange(4), np.ones((4, 7))),)) == ()
