"""Ground truth beside an estimate, in the estimate's frame: a map's own frame is where its first pose is held."""

from collections.abc import Sequence

import numpy as np

from factorbus.cli.driving.columns import position_errors, positions
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Variables

_POSES = ("se2", "se3")


def aligned_truth(truth: Sequence[Variables], estimate: Sequence[Variables]) -> tuple[Variables, ...]:
    """`truth` with its positions moved as one rigid body to where those of the poses fit the estimate's best.

    Nothing where no pose is in both.  Directions of poses stay as they are.
    """
    known = [group for group in truth if group.values is not None]
    keys, there = positions(known, _POSES)
    others, here = positions(estimate, _POSES)
    _, rows, columns = np.intersect1d(keys, others, return_indices=True)
    if not rows.size or there.shape[1] != here.shape[1]:
        return ()
    R, t = _rigid(there[rows], here[columns])
    return tuple(_moved(group, R, t) for group in known if group.values is not None)


def aligned_error_m(truth: Sequence[Variables], estimate: Sequence[Variables]) -> dict[str, float] | None:
    """How far the poses are from `truth`, which `aligned_truth` has moved (metres); None where no pose is in both."""
    errors = position_errors(estimate, aligned_truth(truth, estimate), _POSES)
    if not errors.size:
        return None
    return {"poses": errors.size, "rms": float((errors**2).mean() ** 0.5), "max": float(errors.max())}


def _rigid(there: F64, here: F64) -> tuple[F64, F64]:
    """R, t of the least Σ ‖R pₖ + t − qₖ‖² (Umeyama without scale).

    in   there p (n, d)   here q (n, d)
    """
    middle, other = there.mean(axis=0), here.mean(axis=0)
    U, _, Vt = np.linalg.svd((here - other).T @ (there - middle))
    signs = np.ones(there.shape[1])
    signs[-1] = np.sign(np.linalg.det(U @ Vt))  # a rotation, and no reflection
    R = U @ np.diag(signs) @ Vt
    return R, other - R @ middle


def _moved(group: Variables, R: F64, t: F64) -> Variables:
    if group.values is None:
        raise ValueError(f"variables of kind {group.kind} have no values")
    values, n = group.values.copy(), len(t)
    values[:, :n] = values[:, :n] @ R.T + t
    return group._replace(values=values)
