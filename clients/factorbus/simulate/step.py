"""What a world gives for each pose, and how a block of poses becomes steps."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from factorbus.proto.arrays import F64, I64
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.symbols import symbol

POSE, POINT = symbol("x", 0), symbol("l", 0)
BLOCK = 1024  # poses computed at a time; part of what a seed means


@dataclass(frozen=True, slots=True)
class Step:
    """A new pose with what was measured at it.

    batch: as a robot would insert it; no values but that of the first pose, which is fixed at its truth.
    truth: the true values of the new variables, per kind.
    """

    batch: Batch
    truth: tuple[Variables, ...]


@dataclass(frozen=True, slots=True)
class FactorBlock:
    """Measurements of one kind at a block of poses: keys (m, 2), measured (m, size), information (m, r(r+1)/2), in the
    order of the poses; ends (n,): how many of them belong to the poses up to each one."""

    kind: str
    keys: I64
    measured: F64
    information: F64
    ends: I64


@dataclass(frozen=True, slots=True)
class PointBlock:
    """New points at a block of poses: numbers first, first + 1, ...; truth (m, size); ends as in FactorBlock."""

    kind: str
    first: int
    truth: F64
    ends: I64


def steps_of(
    kind: str, first: int, truth: F64, factors: list[FactorBlock], points: PointBlock | None = None
) -> Iterator[Step]:
    """The steps of a block of poses x_first, x_first + 1, ... with `truth` (n, size)."""
    keys = POSE + np.arange(first, first + len(truth))
    bounds = [[0, *block.ends.tolist()] for block in factors]
    point_keys = POINT + points.first + np.arange(len(points.truth)) if points else keys
    point_bounds = [0, *points.ends.tolist()] if points else [0] * (len(truth) + 1)
    for k in range(len(truth)):
        key, value = keys[k : k + 1], truth[k : k + 1]
        anchor = first + k == 0
        variables = [Variables(kind, key, value if anchor else None, anchor)]
        true_values = [Variables(kind, key, value, anchor)]
        low, high = point_bounds[k], point_bounds[k + 1]
        if points and low < high:
            variables.append(Variables(points.kind, point_keys[low:high]))
            true_values.append(Variables(points.kind, point_keys[low:high], points.truth[low:high]))
        groups = []
        for block, bound in zip(factors, bounds, strict=True):
            low, high = bound[k], bound[k + 1]
            if low < high:
                part = slice(low, high)
                groups.append(Factors(block.kind, block.keys[part], block.measured[part], block.information[part]))
        yield Step(Batch(tuple(variables), tuple(groups)), tuple(true_values))
