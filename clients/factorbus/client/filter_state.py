"""What comes back for a filter, put together: the grown covariance, or factors that any block of it is formed from."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.features import FEATURE, Done, FeaturesAnswer, Observations, ShardDone
from factorbus.proto.problems import BadMessage

_TILE = 64 * FEATURE  # rows and columns transposed at a time


class FilterState(NamedTuple):
    """A filter's state with new features.

    x (m + 6 n,): the new features last.  P (m + 6 n, m + 6 n): symmetric.  y (n, 6): the new features.
    workers: who made them, in order of the features ("in-place": the service).  seconds: the longest that one took.
    """

    x: F64
    P: F64
    y: F64
    workers: tuple[str, ...]
    seconds: float

    @property
    def state(self) -> tuple[F64, F64]:
        """(x, P)"""
        return self.x, self.P


@dataclass(frozen=True, slots=True, eq=False)
class Factored:
    """New features with their covariance as factors; `workers/MATH.md` §5.4.

    y (n, 6).  U (6, m), S (3, 3), turn (n, 4), own (n, 3): `proto/README.md` §15.  sigma_rho: 1/metre.
    """

    y: F64
    U: F64
    S: F64
    turn: F64
    own: F64
    sigma_rho: float

    def before(self, i: int) -> F64:
        """P(new i, before), (6, m)."""
        rows = np.zeros((FEATURE, self.U.shape[1]))
        rows[:3], rows[3:5] = self.U[:3], self._turned(i) @ self.U[3:]
        return rows

    def block(self, i: int, k: int) -> F64:
        """P(new i, new k), (6, 6)."""
        G_i, G_k, C = self._turned(i), self._turned(k), self.U[3:, :3]
        block = np.zeros((FEATURE, FEATURE))
        block[:3, :3] = self.U[:3, :3]
        block[3:5, :3], block[:3, 3:5] = G_i @ C, (G_k @ C).T
        block[3:5, 3:5] = G_i @ self.S @ G_k.T
        if i == k:
            block[3:5, 3:5] += self.own[i][[[0, 1], [1, 2]]]
            block[5, 5] = self.sigma_rho**2
        return block

    def _turned(self, i: int) -> F64:
        """∂(θ, φ)/∂δ of feature i, δ the camera's small rotation about the world's axes."""
        a, b, c, d = self.turn[i]
        return np.array([[a, 1.0, b], [c, 0.0, -d]])


def factored(observations: Observations, answer: FeaturesAnswer) -> Factored:
    """An answer in the form `factored`.  Raises BadMessage."""
    done = [each.shard for each in _in_order(answer, observations.count)]
    U, S = _there("U", done[0].U), _there("S", done[0].S)
    turn = np.concatenate([_there("turn", shard.turn) for shard in done])
    own = np.concatenate([_there("own", shard.own) for shard in done])
    return Factored(np.concatenate([shard.y for shard in done]), U, S, turn, own, observations.sigma_rho)


def augmented(x: F64, P: F64, observations: Observations, answer: FeaturesAnswer, matrix: F64 | None) -> FilterState:
    """State and covariance with the features of an answer in the form `rows` or `half`.  Raises BadMessage.

    matrix (m + 6 n, m + 6 n): where stored rows are, and everything else is put; None: nothing is stored.
    """
    m, n = observations.width, observations.count
    done = _in_order(answer, n)
    if matrix is None:
        if any(each.shard.stored for each in done):
            raise BadMessage("answer.shards", "are stored", "numbers: no memory was sent along")
        matrix = np.empty((m + FEATURE * n, m + FEATURE * n))
    for each in done:
        _place(each.shard, m, n, matrix)
    if any(each.shard.blocks is not None for each in done):
        _mirror(matrix[m:, m:])
    matrix[:m, :m] = P
    for left in range(m, len(matrix), _TILE):
        matrix[:m, left : left + _TILE] = matrix[left : left + _TILE, :m].T
    y = np.concatenate([each.shard.y for each in done])
    workers, seconds = tuple(each.worker for each in done), max(each.seconds for each in done)
    return FilterState(np.concatenate([x, y.reshape(-1)]), matrix, y, workers, seconds)


def _place(shard: ShardDone, m: int, n: int, matrix: F64) -> None:
    """The rows of a shard, or their upper half, where they belong."""
    first, last = m + FEATURE * shard.first, m + FEATURE * shard.last
    if shard.stored or first == last:
        return
    if shard.blocks is None:
        matrix[first:last] = _sized("rows", shard.rows, (last - first, matrix.shape[1]))
        return
    matrix[first:last, :m] = _sized("cross", shard.cross, (last - first, m))
    widths = [FEATURE * (n - i) for i in range(shard.first, shard.last)]
    blocks, at = _sized("blocks", shard.blocks, (FEATURE * sum(widths),)), 0
    for row, width in zip(range(first, last, FEATURE), widths, strict=True):
        matrix[row : row + FEATURE, row:] = blocks[at : at + FEATURE * width].reshape(FEATURE, width)
        at += FEATURE * width


def _mirror(square: F64) -> None:
    """Copy the upper triangle of blocks below the diagonal, in tiles that stay in the cache."""
    size = len(square)
    for top in range(0, size, _TILE):
        rows = slice(top, top + _TILE)
        square[top + _TILE :, rows] = square[rows, top + _TILE :].T
        corner = square[rows, rows]
        for i in range(FEATURE, len(corner), FEATURE):
            corner[i : i + FEATURE, :i] = corner[:i, i : i + FEATURE].T


def _in_order(answer: FeaturesAnswer, n: int) -> Sequence[Done]:
    """The shards, if they are all features once and in order."""
    at = 0
    for done in answer.shards:
        if done.shard.first != at:
            break
        at = done.shard.last
    if at != n or not answer.shards:
        edges = [(done.shard.first, done.shard.last) for done in answer.shards]
        raise BadMessage("answer.shards", f"are features {edges}", f"0 to {n} once and in order")
    return answer.shards


def _there(name: str, array: F64 | None) -> F64:
    if array is None:
        raise BadMessage(f"shard_done.{name}", "missing", "an array")
    return array


def _sized(name: str, array: F64 | None, shape: tuple[int, ...]) -> F64:
    found = _there(name, array)
    if found.shape != shape:
        raise BadMessage(f"shard_done.{name}", f"is {found.shape}", f"{shape}")
    return found
