"""Answers about a map, held against dense matrices: what a client in another language can do with golden messages."""

from typing import Any

import numpy as np
from naive.dense_covariances import DenseCovariance
from naive.dense_factors import jacobians, residual
from naive.dense_least_squares import CONNECTS, rho, weight
from scipy.stats import chi2 as chi2_distribution


def check_blocks(groups: Any, known: DenseCovariance, **tell: float) -> None:
    """The covariances of variables one by one."""
    for group in groups:
        for key, block in zip(group.keys.tolist(), group.covariance, strict=True):
            np.testing.assert_allclose(block, known.joint([key]), **tell)


def check_cross(cross: Any, known: DenseCovariance, **tell: float) -> None:
    """Those of `keys` in rows and `others` in columns."""
    whole, size = known.joint(cross.keys.tolist() + cross.others.tolist()), int(cross.dims.sum())
    np.testing.assert_allclose(cross.covariance, whole[:size, size:], **tell)


def check_candidates(gate: Any, gated: Any, gained: Any, known: DenseCovariance, rel: float) -> None:
    """d², thresholds and gains of the factors in `gate`; some pass and some do not."""
    rows = [
        (group.kind, keys, z, upper)
        for group in gate.factors
        for keys, z, upper in zip(group.keys.tolist(), group.measured, group.information, strict=True)
    ]
    assert len(rows) == len(gated.distance) == len(gained.gain)
    for n, (kind, keys, z, upper) in enumerate(rows):
        r, spread, noise = known.innovation(kind, keys, z, upper)
        np.testing.assert_allclose(gated.distance[n], r @ np.linalg.solve(spread + noise, r), rtol=rel)
        np.testing.assert_allclose(gated.threshold[n], chi2_distribution.ppf(gate.probability, len(r)), rtol=rel)
        gain = 0.5 * np.linalg.slogdet(np.eye(len(r)) + np.linalg.solve(noise, spread))[1]
        np.testing.assert_allclose(gained.gain[n], gain, rtol=rel)
    assert gated.plausible.tolist() == (gated.distance <= gated.threshold).tolist()
    assert set(gated.plausible.tolist()) == {True, False}, "the example has both"


def check_pairs(seen: Any, found: Any, known: DenseCovariance, rel: float) -> None:
    """d² of every pair of observation and landmark that is told."""
    assert len(found.distances)
    for observation, landmark, told in zip(found.observations, found.candidates, found.distances, strict=True):
        ends, z, upper = [seen.pose, int(landmark)], seen.measured[observation], seen.information[observation]
        r, spread, noise = known.innovation(seen.kind, ends, z, upper)
        np.testing.assert_allclose(told, r @ np.linalg.solve(spread + noise, r), rtol=rel)


def check_factor(told: dict[str, Any], known: DenseCovariance, atol: float, rel: float) -> None:
    """What `why` says of a factor, §16."""
    graph = known.graph
    kind, keys, z, W = graph.factors[told["factor"]]
    loss, scale = graph.losses[told["factor"]]
    ends = [graph.values[key] for key in keys]
    r = residual(kind, ends, z)
    s = float(r @ W @ r)
    w = weight(loss, scale, s) if loss else 1.0
    H = np.hstack(jacobians(kind, CONNECTS[kind], ends, z))
    spread = H @ known.joint(keys) @ H.T
    assert (told["kind"], told["keys"], told["loss"], told["dims"]) == (kind, keys, loss, len(r))
    np.testing.assert_allclose(told["residual"], r, atol=atol)
    np.testing.assert_allclose(told["weighted"], np.linalg.cholesky(W).T @ r, atol=20 * atol)
    rest = w**2 * r @ np.linalg.solve(np.linalg.inv(W) - w * spread, spread @ W @ r)
    for name, number in {
        "chi2": s,
        "rho": rho(loss, scale, s),
        "weight": w,
        "leverage": w * np.trace(W @ spread),
        "without": rho(loss, scale, s) + rest,
    }.items():
        np.testing.assert_allclose(told[name], number, rtol=rel, err_msg=name)
