"""The graph that `bus.py` sends: a ring of poses, and noisy edges across it."""

import numpy as np

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

POSES = 10
FACTORS = 10


def ring() -> Batch:
    """POSES poses on a circle, the first one fixed, each tied to the next."""
    angles = 2 * np.pi * np.arange(POSES) / POSES
    values = np.column_stack([np.cos(angles), np.sin(angles), angles])
    names = np.array([symbol("x", n) for n in range(POSES)])
    variables = (Variables("se2", names[:1], values[:1], fixed=True), Variables("se2", names[1:], values[1:]))
    return Batch(variables, (Factors("between_se2", *columns(names[:-1], names[1:], values[:-1], values[1:])),))


def edges(random: np.random.Generator) -> Factors:
    """FACTORS noisy edges between poses of the ring."""
    first = random.integers(0, POSES, FACTORS)
    second = (first + random.integers(1, POSES, FACTORS)) % POSES
    angles = 2 * np.pi * np.arange(POSES) / POSES
    values = np.column_stack([np.cos(angles), np.sin(angles), angles])
    names = np.array([symbol("x", n) for n in range(POSES)])
    ends, measured, information = columns(names[first], names[second], values[first], values[second])
    return Factors("between_se2", ends, measured + random.normal(0, 0.01, measured.shape), information)


def columns(i: np.ndarray, j: np.ndarray, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Keys, measurements b in a's frame, and information of edges from i to j."""
    c, s, d = np.cos(a[:, 2]), np.sin(a[:, 2]), b - a
    measured = np.column_stack([c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1], d[:, 2]])
    information = np.tile([100.0, 0, 0, 100, 0, 400], (len(a), 1))
    return np.column_stack([i, j]), measured, information
