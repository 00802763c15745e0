"""The covariance by what its structure leaves to multiply: whole, half, or as factors.  MATH §5.3, §5.4."""

from typing import NamedTuple

import numpy as np

from factorbus.idp.classical import Counted
from factorbus.idp.kernels import minimal as kernels
from factorbus.idp.kernels.compile import F64
from factorbus.idp.new_features import Seen, contiguous
from factorbus.proto.features import FEATURE, Observations


class Half(NamedTuple):
    """The upper half of the new rows of features first .. last−1.

    cross (6 k, m): P(new, before).  blocks: for each feature i its P(new i, new i .. n−1), 6 × 6 (n − i), one after
    the other.
    """

    cross: F64
    blocks: F64
    multiplications: int


class CovarianceFactors(NamedTuple):
    """Numbers from which any block can be formed: six rows that all features share, and seven numbers a feature.

    U (6, m), S (3, 3) of (5.4).  turn (n, 4).  own (n, 3): σ² M Mᵀ: θθ, θφ, φφ (radians²).
    """

    U: F64
    S: F64
    turn: F64
    own: F64
    multiplications: int


def covariance(P: F64, observations: Observations, seen: Seen, out: F64 | None = None) -> Counted:
    """P after adding the features of `observations`.

    in   P (m, m), of which observations.covariance are the first 13 rows
    out  P (m + 6 n, m + 6 n), in `out` if it is given
    """
    m, n = len(P), len(seen.y)
    after = np.empty((m + FEATURE * n, m + FEATURE * n)) if out is None else out
    after[:m, :m] = P
    new = FeatureRows(observations, seen)
    count = new.multiplications + new.rows(0, n, after[m:])
    kernels.mirror(m, after)
    return Counted(after, count)


class FeatureRows:
    """What the new rows are made of: O(m + n) numbers, from which any rows can be had.

    first: rows of features before this one are not asked for, nor, by the upper half, blocks with them.
    multiplications: what making these took.
    """

    def __init__(self, observations: Observations, seen: Seen, first: int = 0) -> None:
        n = len(seen.y)
        self._variance = observations.sigma_rho * observations.sigma_rho
        U, S, count = _shared(observations)
        V, W, own = np.empty((n, 6)), np.empty((n, 6)), np.empty((n, 3))
        count += kernels.feature_factors(first, seen.turn, U, S, V, W)
        count += kernels.own_variances(seen.slope[first:], observations.sigma_pixel, own[first:])
        self._factors = kernels.RowFactors(seen.turn, U, V, W, own)
        self.multiplications = count

    def rows(self, first: int, last: int, out: F64) -> int:
        """P(new, (before, new)) of features first .. last−1 into `out` (6 (last − first), m + 6 n).  MATH (5.5)–(5.7)

        Gives the number of multiplications.  Needs all parts.  The bits of a row do not depend on which rows are asked
        for with it.
        """
        return kernels.full_rows(self._factors, first, last, self._variance, out)

    def half(self, first: int, last: int) -> Half:
        """The upper half of the rows of features first .. last−1, with the bits of `rows`."""
        cross = np.empty((FEATURE * (last - first), self._factors.U.shape[1]))
        blocks = np.empty(blocks_in(len(self._factors.turn), first, last) * FEATURE * FEATURE)
        count = kernels.half_rows(self._factors, first, last, self._variance, cross, blocks)
        return Half(cross, blocks, count)


def covariance_factors(
    observations: Observations, seen: Seen, first: int = 0, last: int | None = None
) -> CovarianceFactors:
    """The factors, of features first .. last−1: O(m + n) numbers and multiplications.  MATH §5.4"""
    chosen = Seen(*(array[first:last] for array in seen))
    U, S, count = _shared(observations)
    own = np.empty((len(chosen.y), 3))
    count += kernels.own_variances(chosen.slope, observations.sigma_pixel, own)
    return CovarianceFactors(U, S, chosen.turn, own, count)


def blocks_in(n: int, first: int, last: int) -> int:
    """6 × 6 blocks in the upper half of the rows of features first .. last−1 of n."""
    return (last - first) * n - (last * (last - 1) - first * (first - 1)) // 2


def _shared(observations: Observations) -> tuple[F64, F64, int]:
    U, S = np.empty((6, observations.width)), np.empty((3, 3))
    count = kernels.share(contiguous(observations.state), contiguous(observations.covariance), U, S)
    return U, S, count
