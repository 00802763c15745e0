"""Steps that turn much of a map."""

from collections.abc import Iterator

import numpy as np

from bench.replays.columns import F64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

X = symbol("x", 0)


def drift(poses: int, seed: int) -> Iterator[Batch]:
    """A round of `poses` poses whose heading drifts by 60° to 180°, and then one loop closure, of a step of its own."""
    alpha = np.radians(np.random.default_rng([seed, 11]).uniform(60.0, 180.0))
    z = np.array([1.0, 0.0, (2 * np.pi + alpha) / (poses - 1)])
    yield Batch((Variables("se2", np.array([X]), np.zeros((1, 3)), True),))
    for i in range(1, poses):
        yield Batch((Variables("se2", np.array([X + i])),), (between(X + i - 1, X + i, z, (0.05, 0.05, 0.03)),))
    yield Batch((), (between(X + poses - 1, X, np.zeros(3), (0.1, 0.1, 0.05)),))


def between(i: int, j: int, z: F64, sigmas: tuple[float, ...], kind: str = "between_se2") -> Factors:
    """One relative pose."""
    return Factors(kind, np.array([[i, j]]), z[None], packed(sigmas)[None])


def packed(sigmas: tuple[float, ...]) -> F64:
    """diag(1/σ²) as its upper triangle (r(r+1)/2,)."""
    return np.diag(np.array(sigmas) ** -2.0)[np.triu_indices(len(sigmas))]
