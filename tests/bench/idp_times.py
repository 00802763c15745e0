"""Seconds of each computation of the covariance, in one process, with the multiplications that the same run counted.

`classical` are compiled loops as `independent` has them; `classical-blas` is the same J P Jᵀ by NumPy, whose BLAS is
the fastest multiplication there is: what a filter in practice loses.  Beyond `_WHOLE` features the classical ones are
not run to the end: one step that is run is scaled by what all steps multiply, and the row says `extrapolated`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from bench.idp_paper import half_count
from naive.random_cameras import random_observations

from factorbus import idp
from factorbus.idp import classical, independent, minimal
from factorbus.idp.kernels.dense import counted_product
from factorbus.proto.arrays import F64
from factorbus.proto.features import FEATURE, Observations

_WHOLE = 100
_LAST_STEP = 150  # the state's features at the step that stands for all of a longer run
_BUDGET_S, _MOST = 0.6, 15


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """New features of a filter that has some already; the array for the result is there and has been touched."""

    features: int
    existing: int
    observations: Observations
    seen: idp.Seen
    P: F64
    A: F64
    B: F64
    padd: F64
    out: F64

    def row(self, method: str, run: Callable[[], int]) -> dict[str, Any]:
        """The row of a method whose run gives its multiplications."""
        seconds, count = _best(run)
        row = {"features": self.features, "existing": self.existing, "method": method, "multiplications": count}
        return row | {"seconds": seconds, "workers": 0, "extrapolated": False}


def case(features: int, existing: int = 0) -> Case:
    """A random one."""
    observations, P = random_observations(1, features, existing)
    seen = idp.see(observations)
    out = np.full((len(P) + FEATURE * features,) * 2, 1.0)
    return Case(
        features, existing, observations, seen, P, *idp.jacobians(observations, seen), idp.padd(observations), out
    )


def rows(features: int, existing: int = 0) -> list[dict[str, Any]]:
    """A row per method.  What every method starts from (y, the Jacobians, slopes) is made before."""
    c = case(features, existing)
    return [
        _classical(c, blas=False),
        _classical(c, blas=True),
        c.row("independent", lambda: independent.covariance(c.P, c.A, c.B, c.padd, c.out).multiplications),
        c.row("minimal", lambda: minimal.covariance(c.P, c.observations, c.seen, c.out).multiplications),
        c.row("minimal-half", lambda: half_count(c.observations, c.seen)),
        c.row("factored", lambda: minimal.covariance_factors(c.observations, c.seen).multiplications),
    ]


def factored(features: int) -> list[dict[str, Any]]:
    """The factored form of many features: from y and slopes, as the other methods, and all the way from pixels."""
    c = case(0)
    observations, _ = random_observations(1, features)
    c = replace(c, features=features, observations=observations, seen=idp.see(observations))
    return [
        c.row("factored", lambda: minimal.covariance_factors(observations, c.seen).multiplications),
        c.row(
            "factored-from-pixels",
            lambda: minimal.covariance_factors(observations, idp.see(observations)).multiplications,
        ),
    ]


def written(n: int) -> float:
    """Seconds to write a whole covariance of n features into memory that is there: nothing computed."""
    matrix = np.zeros((13 + FEATURE * n, 13 + FEATURE * n))
    return _best(lambda: matrix.fill(1.0))[0]


def _classical(c: Case, blas: bool) -> dict[str, Any]:
    """Step after step; see the head of this file."""
    name = "classical-blas" if blas else "classical"
    if c.features <= _WHOLE:
        return c.row(name, lambda: _all_steps(c, blas))
    state = np.random.default_rng(1).normal(size=(13 + FEATURE * (c.existing + _LAST_STEP),) * 2)
    J, padded = classical.step_matrices(state, c.A[0], c.B[0], c.padd)
    left, after, Jt = np.empty(J.shape), np.empty((len(J), len(J))), np.ascontiguousarray(J.T)
    if blas:
        seconds, _ = _best(lambda: np.matmul(np.matmul(J, padded, out=left), Jt, out=after))
        count = J.size * len(padded) + left.size * len(J)
    else:
        seconds, count = _best(lambda: counted_product(J, padded, left) + counted_product(left, Jt, after))
    sizes = [(len(c.P) + FEATURE * k + FEATURE, len(c.P) + FEATURE * k + 3) for k in range(c.features)]
    total = sum(a * b * b + a * a * b for a, b in sizes)
    row = {"features": c.features, "existing": c.existing, "method": name, "multiplications": total}
    return row | {"seconds": seconds * total / count, "workers": 0, "extrapolated": True}


def _all_steps(c: Case, blas: bool) -> int:
    if not blas:
        return classical.covariance(c.P, c.A, c.B, c.padd).multiplications
    P, count = c.P, 0
    for A_k, B_k in zip(c.A, c.B, strict=True):
        J, padded = classical.step_matrices(P, A_k, B_k, c.padd)
        count += J.size * len(padded) + J.size * len(J)
        P = J @ padded @ J.T
    return count


def _best(run: Callable[[], Any]) -> tuple[float, Any]:
    """(seconds of the best of several runs, what the last one gave)."""
    best, spent, times = np.inf, 0.0, 0
    while times == 0 or (spent < _BUDGET_S and times < _MOST):
        started = time.perf_counter()
        result = run()
        took = time.perf_counter() - started
        best, spent, times = min(best, took), spent + took, times + 1
    return best, result
