"""g2o as a contestant: the whole graph anew at every step that has something to solve, or at every tenth pose.

The wheel's linear solver is Eigen's sparse Cholesky on g2o's block ordering; it has neither CHOLMOD nor CSparse.
"""

from typing import Any

import g2opy as g2o
import numpy as np

from factorbus.proto.messages import Batch

from .columns import F64, Values, symmetric
from .compose import first_values
from .contestants import Failed

_ITERATIONS = 10
_GAIN = 1e-6  # the tolerance of our own batch solver


class G2oBatch:
    """What is on the clock: `initialize_optimization` and `optimize`.  The vertices hold the estimate."""

    def __init__(self, every: int) -> None:
        self._every = every
        self._optimizer = g2o.SparseOptimizer()
        solver = g2o.BlockSolverX(g2o.LinearSolverEigenX())
        self._algorithm = g2o.OptimizationAlgorithmGaussNewton(solver)
        self._optimizer.set_algorithm(self._algorithm)
        self._enough = g2o.SparseOptimizerTerminateAction()
        self._enough.set_gain_threshold(_GAIN)
        self._enough.set_max_iterations(_ITERATIONS)
        self._optimizer.add_post_iteration_action(self._enough)
        self._ids: dict[int, int] = {}
        self._vertices: dict[int, tuple[str, Any]] = {}
        self._since = self._loops = 0
        self._count = {"batch": 0, "extend": 0}
        self._iterations = 0

    def prepare(self, batch: Batch) -> None:
        """g2o's vertices and edges, with first values composed from the present estimate."""
        fixed = {key for group in batch.variables if group.fixed for key in group.keys.tolist()}
        new = first_values(batch, self._known)
        for key, (kind, value) in new.items():
            self._ids[key] = len(self._ids)
            vertex = VERTICES[kind]()
            vertex.set_id(self._ids[key])
            vertex.set_fixed(key in fixed)
            vertex.set_estimate_data(value)
            if not self._optimizer.add_vertex(vertex):
                raise Failed(f"g2o refused a vertex of kind {kind}")
            self._vertices[key] = (kind, vertex)
        for group in batch.factors:
            self._add_edges(group.kind, group.keys.tolist(), group.measured, symmetric(group.information))
        self._since += 1
        self._loops += batch.factor_count - len([key for key in new if key not in fixed])

    def step(self) -> None:
        """Raises Failed when the linear solver gives up."""
        if self._loops <= 0 or (self._every > 1 and self._since < self._every):
            self._count["extend"] += 1
            return
        if not self._optimizer.initialize_optimization():
            raise Failed("initialize_optimization failed")
        done = self._optimizer.optimize(_ITERATIONS)
        if done <= 0:
            raise Failed("optimize failed: the system is not positive definite")
        self._iterations += done
        self._count["batch"] += 1
        self._since = self._loops = 0

    def read(self) -> None:
        """The vertices hold it."""

    def values(self) -> Values:
        """One by one through the binding; this is not on the clock."""
        found: dict[str, tuple[list[int], list[Any]]] = {}
        for key, (kind, vertex) in self._vertices.items():
            keys, rows = found.setdefault(kind, ([], []))
            keys.append(key)
            rows.append(vertex.get_estimate_data())
        return {kind: (np.array(keys), np.array(rows)) for kind, (keys, rows) in found.items()}

    def chi2(self) -> float:
        """By g2o's own arithmetic, for the check of the common evaluator."""
        self._optimizer.initialize_optimization()
        self._optimizer.compute_active_errors()
        return float(self._optimizer.active_chi2())

    def facts(self) -> dict[str, Any]:
        """nnz_r is g2o's own count, from one further iteration."""
        nnz_r = None
        if self._count["batch"]:
            self._optimizer.set_compute_batch_statistics(True)
            self._optimizer.initialize_optimization()
            self._optimizer.optimize(1)
            nnz_r = int(max(row.choleskyNNZ for row in self._optimizer.batch_statistics())) or None
        return {"nnz_r": nnz_r, "strategies": dict(self._count), "iterations": self._iterations}

    def _add_edges(self, kind: str, keys: list[list[int]], measured: F64, information: F64) -> None:
        for (i, j), z, omega in zip(keys, measured, information, strict=True):
            if kind not in EDGES:
                raise Failed(f"no edge for {kind} here")
            edge = EDGES[kind]()
            edge.set_vertex(0, self._vertices[i][1])
            edge.set_vertex(1, self._vertices[j][1])
            edge.set_measurement_data(z)
            edge.set_information(omega)
            if not self._optimizer.add_edge(edge):
                raise Failed(f"g2o refused an edge of kind {kind}")

    def _known(self, kind: str, key: int) -> F64:
        return np.asarray(self._vertices[key][1].get_estimate_data(), float)


VERTICES = {"se2": g2o.VertexSE2, "se3": g2o.VertexSE3, "point2": g2o.VertexPointXY}
EDGES = {"between_se2": g2o.EdgeSE2, "between_se3": g2o.EdgeSE3, "landmark_se2": g2o.EdgeSE2PointXY}
