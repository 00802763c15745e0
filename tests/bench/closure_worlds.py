"""What `closures` drives through: streets drawn anew, and public data sets whose own closures count as right."""

from functools import lru_cache
from typing import Any

import numpy as np
from false_closures import DriveWithFalse, drive_with_false, with_false

from factorbus.datasets import find
from factorbus.formats import read
from factorbus.proto.messages import Batch, Factors
from factorbus.solver import Options, Solver

WORLDS = ("streets", "intel", "sphere", "city")
_FILES = {"intel": "intel", "sphere": "sphere2500", "city": "city10000"}
SLACK_M = {"intel": 0.01}  # what is added to errors where the optimum is the truth, which the last step comes to


def world(name: str, poses: int, seed: int, share: float, kind: str) -> DriveWithFalse:
    """One with false closures; share: of all closures, the false ones.  Raises FileNotFoundError, KeyError."""
    if name == "streets":
        return drive_with_false(poses, seed, share, kind)
    batches, truth = _public(name)
    return with_false(batches[:poses], truth[:poses], seed, share, kind)


def error_of(solver: Any, truth: np.ndarray) -> float:
    """Root mean square of positions, best laid upon the truth (ATE), metres."""
    size = 2 if truth.shape[1] == 3 else 3
    a, b = _estimated(solver)[:, :size], truth[:, :size]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = U @ np.diag([1.0] * (size - 1) + [np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return float(np.sqrt(((a @ R - b) ** 2).sum(axis=1).mean()))


def _estimated(solver: Any) -> np.ndarray:
    """Poses in the order of their keys."""
    if isinstance(solver, Solver):
        groups = [(group.keys, group.values) for group in solver.estimate()]
    else:
        groups = list(solver.values().values())
    keys, values = np.concatenate([keys for keys, _ in groups]), np.concatenate([values for _, values in groups])
    return values[np.argsort(keys)]


@lru_cache(maxsize=2)
def _public(name: str) -> tuple[list[Batch], np.ndarray]:
    """A data set pose by pose, and its true poses: the ground truth, of intel the optimum."""
    path = find(_FILES[name])
    if path is None:
        raise FileNotFoundError(f"data set {name} is not on this machine: factorbus datasets fetch {name}")
    batches = list(read(path).steps())
    if name == "sphere":
        batches = [batch._replace(factors=tuple(_squared(group) for group in batch.factors)) for batch in batches]
    if name != "intel":
        return batches, np.loadtxt(path.parent / "groundtruth" / f"{_FILES[name]}_groundtruth.txt")[:, 1:]
    solver = Solver(Options())
    for batch in batches:
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    return batches, _estimated(solver)


def _squared(group: Factors) -> Factors:
    """With Ω² of rotation vectors, which fits the noise (χ² of the truth is 1.02 a number): the file has its root."""
    halves, rows, columns = np.array([1.0] * 3 + [0.5] * 3), *np.triu_indices(6)
    W = np.zeros((len(group.keys), 6, 6))
    W[:, rows, columns] = W[:, columns, rows] = group.information
    W *= np.outer(halves, halves)
    return group._replace(information=((W @ W) / np.outer(halves, halves))[:, rows, columns])
