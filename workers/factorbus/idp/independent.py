"""The covariance by independent rows of blocks: Idris and others, 2011.  MATH §5.2."""

import numpy as np

from factorbus.idp.classical import Counted
from factorbus.idp.kernels.compile import F64, I64
from factorbus.idp.kernels.independent import COUNTS, add_own_blocks, camera_blocks, feature_blocks
from factorbus.proto.features import CAMERA_STATE, FEATURE


def covariance(P: F64, A: F64, B: F64, padd: F64, out: F64 | None = None) -> Counted:
    """P after adding n features, from stored products A P.  MATH (5.3)

    in   P (m, m)   A (n, 6, 13)   B (n, 6, 3)   padd (3, 3)
    out  P (m + 6 n, m + 6 n), in `out` if it is given
    """
    m, n = len(P), len(A)
    after = np.empty((m + FEATURE * n, m + FEATURE * n)) if out is None else out
    after[:m, :m] = P
    counts = np.zeros(COUNTS, np.int64)
    some_rows(0, n, np.ascontiguousarray(P[:CAMERA_STATE]), A, B, padd, after, counts)
    return Counted(after, int(counts.sum()))


def some_rows(first: int, last: int, before: F64, A: F64, B: F64, padd: F64, out: F64, counts: I64) -> None:
    """The rows and columns of features first .. last−1 in `out`.

    in   before (13, m): the camera's rows of P
    out  counts (5,): multiplications are added, by part (`kernels/independent.py`)
    """
    At = np.ascontiguousarray(A.transpose(2, 0, 1).reshape(CAMERA_STATE, -1))
    camera_blocks(first, last, before, A, out, counts)
    feature_blocks(first, last, At, out, counts)
    add_own_blocks(first, last, B, padd, np.empty((2 * FEATURE, FEATURE)), out, counts)
