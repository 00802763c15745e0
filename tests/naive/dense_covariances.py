"""Covariances from dense inverses, and association by trying everything: the twins of `factorbus.solver.covariance`."""

import itertools

import numpy as np
from naive.dense_factors import TANGENT, jacobians, residual
from naive.dense_least_squares import CONNECTS, DenseGraph, full


class DenseCovariance:
    """Σ = Λ⁻¹ of a dense graph at its values, for all its variables; fixed ones have none."""

    def __init__(self, graph: DenseGraph) -> None:
        self.graph, self.starts = graph, graph.starts()
        information, _ = graph.system()
        scale = np.sqrt(np.diag(information))
        # What differences instead of Jacobians, and inverting, may cost: relative.
        self.tell = max(1e-8, 1e-13 * float(np.linalg.cond(information / scale / scale[:, None])))
        self.sigma = np.linalg.inv(information / scale / scale[:, None]) / scale / scale[:, None]

    def joint(self, keys: list[int]) -> np.ndarray:
        """Of several variables together, zero for those that are fixed."""
        size = len(self.sigma)
        padded = np.zeros((size + 1, size + 1))
        padded[:size, :size] = self.sigma
        places = np.concatenate([self._places(key) for key in keys])
        return padded[np.ix_(places, places)]

    def innovation(self, kind: str, keys: list[int], z: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, ...]:
        """(r, H Σ Hᵀ, Ω⁻¹) of a factor that is not in the graph."""
        ends = [self.graph.values[key] for key in keys]
        H = np.hstack(jacobians(kind, CONNECTS[kind], ends, z))
        return residual(kind, ends, z), H @ self.joint(keys) @ H.T, np.linalg.inv(full(upper))

    def _places(self, key: int) -> np.ndarray:
        dim = TANGENT[self.graph.kinds[key]]
        return self.starts[key] + np.arange(dim) if key in self.starts else np.full(dim, len(self.sigma))


def best_association(S: np.ndarray, r: np.ndarray, pairs: list[tuple[int, int]], dim: int, gates: np.ndarray):
    """(d², pairs) of the largest jointly compatible set of (observation, landmark) pairs, the nearest of those."""
    best: tuple[int, float, tuple[int, ...]] = (0, 0.0, ())
    for count in range(1, len({observation for observation, _ in pairs}) + 1):
        for some in itertools.combinations(range(len(pairs)), count):
            if len({pairs[q][0] for q in some}) < count or len({pairs[q][1] for q in some}) < count:
                continue
            rows = np.concatenate([np.arange(q * dim, (q + 1) * dim) for q in some])
            d2 = float(r[rows] @ np.linalg.solve(S[np.ix_(rows, rows)], r[rows]))
            if d2 <= gates[count] and (count > best[0] or d2 < best[1]):
                best = (count, d2, some)
    return best[1], best[2]
