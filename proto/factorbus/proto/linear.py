"""What the numbers of a linear factor are: y of its variables, H of each, b."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS


class Parts(NamedTuple):
    """Of n linear factors of a kind, for each variable: its kind, y (n, size), H (n, rows, d); and b (n, rows)."""

    kinds: tuple[str, ...]
    y: list[F64]
    H: list[F64]
    b: F64

    def measured(self) -> F64:
        """Side by side, as the wire has them."""
        return np.concatenate([*self.y, *(H.reshape(len(H), -1) for H in self.H), self.b], axis=1)


def parts_of(kind: str, measured: F64) -> Parts:
    """The parts of `measured` (n, size) of the linear factors of a kind."""
    of = FACTOR_KINDS[kind]
    ends = [VARIABLE_KINDS[end] for end in of.connects]
    *y, rest = _cut(measured, [end.size for end in ends])
    *H, b = _cut(rest, [of.dim * end.dim for end in ends])
    return Parts(of.connects, y, [J.reshape(-1, of.dim, end.dim) for J, end in zip(H, ends, strict=True)], b)


def _cut(columns: F64, widths: Sequence[int]) -> list[F64]:
    return np.split(columns, np.cumsum(widths), axis=1)
