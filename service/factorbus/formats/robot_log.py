"""What a log of robots has beside its graph: when which robot measured what, ground truth, and labels of outliers."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from factorbus.proto.arrays import I64
from factorbus.proto.messages import Variables
from factorbus.proto.symbols import symbol_parts
from factorbus.wording import counted


@dataclass(frozen=True, slots=True)
class FactorLabels:
    """Of one group of factors, all (m,): when each was measured, in nanoseconds, by which robot, the code of its
    letter, whether it may be an outlier (a loop closure, say), and whether it is one.
    """

    stamps: I64
    robots: I64
    potential: NDArray[np.bool]
    outlier: NDArray[np.bool]


@dataclass(frozen=True, slots=True)
class RobotLog:
    """name: of the data set.  labels: one for each group of factors of the graph, or none.  ground_truth: values
    and time stamps.
    """

    name: str
    labels: tuple[FactorLabels, ...]
    ground_truth: tuple[Variables, ...] = ()

    @property
    def potential_outliers(self) -> int:
        """Number of factors that may be outliers."""
        return sum(int(group.potential.sum()) for group in self.labels)

    @property
    def outliers(self) -> int:
        """Number of factors that are."""
        return sum(int(group.outlier.sum()) for group in self.labels)

    @property
    def known(self) -> int:
        """Number of variables with ground truth."""
        return sum(len(group.keys) for group in self.ground_truth)

    def counts(self) -> dict[str, int]:
        """For a program."""
        return {
            "ground_truth": self.known,
            "potential_outliers": self.potential_outliers,
            "outliers": self.outliers,
        }

    def told(self) -> str:
        """For people; empty where there is nothing but the graph."""
        parts = [f"ground truth of {counted(self.known, 'variable')}"] if self.known else []
        if self.potential_outliers or self.outliers:
            parts.append(
                f"labels: {counted(self.potential_outliers, 'potential outlier')}, {counted(self.outliers, 'outlier')};"
                " they are factors as all others"
            )
        return "; ".join(parts)


def first_mentions(entries: Iterable[tuple[str, int, Iterable[int]]]) -> dict[int, int]:
    """The time stamp of each variable: that of the first entry of its own robot that names it, or else of any.

    entries: (robot, stamp, keys), by time.
    """
    own: dict[int, int] = {}
    other: dict[int, int] = {}
    for robot, stamp, keys in entries:
        for key in keys:
            (own if symbol_parts(key)[0] == robot else other).setdefault(key, stamp)
    return other | own
