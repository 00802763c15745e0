"""Whether two estimates of the same variables are in about the same place, however their rotations are written."""

import numpy as np

from factorbus.proto.kinds import VARIABLE_KINDS
from factorbus.solver.graph.factor_graph import FactorGraph
from factorbus.solver.kernels.jit.compile import F64, I64
from factorbus.solver.kernels.model import layout as at

# How far values of the same place may differ: a share of how far the map reaches, or of what numbers without a place
# are; for rotations, radians, or numbers of a quaternion.
_SHARE, _TURN = 2e-3, 0.05
# How many numbers of a variable, the first ones, say where it is.
_PLACES = {at.SE2: 2, at.POINT2: 2, at.SE3: 3, at.POINT3: 3, at.IDP: 3, at.SIM3: 3}


class SamePlace:
    """Compares estimates of one graph.  How far a map is from its origin does not matter; q and −q are the same
    rotation, as θ and θ + 2π are; and lenses, biases and scales have a size of their own.
    """

    def __init__(self, graph: FactorGraph) -> None:
        rows = graph.var[: int(graph.counts[at.VARIABLES])]
        kinds = [*VARIABLE_KINDS.values()]
        self._places: list[I64] = []
        self._plain: list[I64] = []
        self._quaternions, self._angles = np.empty((0, 4), np.int64), np.empty(0, np.int64)
        for code in np.unique(rows[:, at.V_KIND]).tolist():
            starts, kind, dim = rows[rows[:, at.V_KIND] == code, at.V_AT], kinds[code], _PLACES.get(code, 0)
            columns = set(range(dim, kind.size))
            self._places += [starts + column for column in range(dim)]
            if kind.quaternion_at >= 0:
                turns = kind.quaternion_at + np.arange(4)
                self._quaternions = np.concatenate([self._quaternions, starts[:, None] + turns])
                columns -= set(turns.tolist())
            if code == at.SE2:
                self._angles, columns = starts + 2, set()
            self._plain += [starts + column for column in sorted(columns)]

    def __call__(self, one: F64, other: F64) -> bool:
        """Whether no value of `one` is further from that of `other` than by a small share."""
        q = self._quaternions
        sign = np.where((one[q] * other[q]).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        angles = (one[self._angles] - other[self._angles] + np.pi) % (2.0 * np.pi) - np.pi
        turned = max(np.abs(one[q] - sign * other[q]).max(initial=0.0), np.abs(angles).max(initial=0.0))
        if not turned <= _TURN:
            return False
        spread = [np.square(other[each] - other[each].mean()) for each in self._places]
        reach = float(np.sqrt(np.concatenate(spread).mean())) if spread else 0.0
        sizes = [float(np.sqrt(np.square(other[each]).mean())) for each in self._plain]
        return all(
            np.abs(one[each] - other[each]).max(initial=0.0) <= _SHARE * size
            for each, size in zip([*self._places, *self._plain], [reach] * len(self._places) + sizes, strict=True)
        )
