"""The covariance as filters compute it: one feature after the other, J P Jᵀ on the whole state.  MATH §5.1."""

from typing import NamedTuple

import numpy as np

from factorbus.idp.kernels.compile import F64
from factorbus.idp.kernels.dense import counted_product
from factorbus.proto.features import CAMERA_STATE, FEATURE


class Counted(NamedTuple):
    """A covariance and the multiplications that made it."""

    P: F64
    multiplications: int


def covariance(P: F64, A: F64, B: F64, padd: F64) -> Counted:
    """P after adding n features, as the pseudocode of the paper's Figure 4.  MATH (5.2)

    in   P (m, m)   A (n, 6, 13)   B (n, 6, 3)   padd (3, 3)
    out  P (m + 6 n, m + 6 n)
    """
    count = 0
    for A_k, B_k in zip(A, B, strict=True):
        P, more = step(P, A_k, B_k, padd)
        count += more
    return Counted(P, count)


def step(P: F64, A_k: F64, B_k: F64, padd: F64) -> Counted:
    """P ← J blkdiag(P, Padd) Jᵀ with J = [ I 0 ; A 0 B ]: one feature."""
    J, padded = step_matrices(P, A_k, B_k, padd)
    left, after = np.empty(J.shape), np.empty((len(J), len(J)))
    count = counted_product(J, padded, left)
    count += counted_product(left, np.ascontiguousarray(J.T), after)
    return Counted(after, count)


def step_matrices(P: F64, A_k: F64, B_k: F64, padd: F64) -> tuple[F64, F64]:
    """J (m + 6, m + 3) and blkdiag(P, Padd) (m + 3, m + 3)."""
    m = len(P)
    J = np.zeros((m + FEATURE, m + 3))
    J[:m, :m] = np.eye(m)
    J[m:, :CAMERA_STATE], J[m:, m:] = A_k, B_k
    padded = np.zeros((m + 3, m + 3))
    padded[:m, :m], padded[m:, m:] = P, padd
    return J, padded
