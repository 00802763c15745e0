"""Solvers of whole graphs, ours and others, each given the same graph with the same values in memory.

`prepare` makes a solver's own objects and is off the clock, as is `reset`, after which `run` begins at the values that
were given; `run` is on it.  χ² at the end of each is in one convention, g2o's, by one function.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from typing import Any

import numpy as np
from bench.replays.columns import F64, symmetric
from bench.replays.contestants import Failed

from factorbus.proto.messages import Batch, Variables
from factorbus.solver import BatchSearch, chi2_at, solve_batch

_TOLERANCE = 1e-6  # of GTSAM and g2o: the relative decrease below which they stop; ours stops at 1e-11, predicted
_MOST = 200
# Metres and radians of GTSAM's priors where several variables are held, so that measurements pull at them.
_RIGID = 1e-6


@dataclass(frozen=True, slots=True)
class End:
    """Where a solver stopped.  own_chi2: by its own factors, where these differ from g2o's."""

    iterations: int
    values: Callable[[], tuple[Variables, ...]]
    own_chi2: float | None = None


@dataclass(frozen=True, slots=True)
class Prepared:
    """A solver with a graph.  kept: what must not be collected before."""

    run: Callable[[], End]
    reset: Callable[[], None] = lambda: None
    kept: tuple[Any, ...] = ()


def ours(start: str) -> Callable[[Batch], Prepared]:
    """`solve_batch` as `factorbus solve` calls it, admission and the values of the optimum included."""

    def prepare(graph: Batch) -> Prepared:
        search = BatchSearch(start, polish=False)

        def run() -> End:
            found = solve_batch(graph.variables, graph.factors, search)
            return End(
                found.iterations, lambda: tuple(Variables(g.kind, g.keys, g.values, g.fixed) for g in found.values)
            )

        return Prepared(run)

    return prepare


def gtsam_optimizer(make: str) -> Callable[[Batch], Prepared]:
    """GTSAM's: lm, lm-qr or gn; ordering is on the clock, as it is in ours."""

    def prepare(graph: Batch) -> Prepared:
        import gtsam
        from bench.replays.gtsam_factors import gtsam_factors, held
        from bench.replays.isam2 import insert_value, read_kinds

        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for group in graph.variables:
            for key, row in zip(group.keys.tolist(), group.values, strict=True):
                insert_value(values, group.kind, key, row)
        fixed = [(group.kind, key) for group in graph.variables if group.fixed for key in group.keys.tolist()]
        for kind, key in fixed:
            factors.add(held(kind, key, values, *([_RIGID] if len(fixed) > 1 else [])))
        for group in graph.factors:
            for factor in gtsam_factors(group):
                factors.add(factor)
        kinds = {group.kind for group in graph.variables}
        parameters = gtsam.GaussNewtonParams() if make == "gn" else gtsam.LevenbergMarquardtParams()
        parameters.setRelativeErrorTol(_TOLERANCE)
        parameters.setAbsoluteErrorTol(1e-9)
        parameters.setMaxIterations(_MOST)
        parameters.setLinearSolverType("MULTIFRONTAL_QR" if make == "lm-qr" else "MULTIFRONTAL_CHOLESKY")
        optimizer = gtsam.GaussNewtonOptimizer if make == "gn" else gtsam.LevenbergMarquardtOptimizer

        def run() -> End:
            try:
                found = optimizer(factors, values, parameters)
                end = found.optimize()
            except RuntimeError as problem:
                raise Failed(" ".join(str(problem).split())[:120]) from problem
            return End(
                found.iterations(),
                lambda: tuple(Variables(kind, *each) for kind, each in read_kinds(end, kinds).items()),
                2 * found.error(),
            )

        return Prepared(run)

    return prepare


def g2o_optimizer(make: str) -> Callable[[Batch], Prepared]:
    """g2o's: lm or gn, with blocks of fixed size where it has them for the graph, and Eigen's sparse Cholesky."""

    def prepare(graph: Batch) -> Prepared:
        import g2opy as g2o
        from bench.g2o_models import g2o_model

        model = g2o_model(graph)
        solver = getattr(g2o, f"BlockSolver{model.size}")(getattr(g2o, f"LinearSolverEigen{model.size}")())
        make_algorithm = g2o.OptimizationAlgorithmGaussNewton if make == "gn" else g2o.OptimizationAlgorithmLevenberg
        algorithm, optimizer = make_algorithm(solver), g2o.SparseOptimizer()
        optimizer.set_algorithm(algorithm)
        enough = g2o.SparseOptimizerTerminateAction()
        enough.set_gain_threshold(_TOLERANCE)
        enough.set_max_iterations(_MOST)
        optimizer.add_post_iteration_action(enough)
        vertices: dict[int, tuple[Any, F64]] = {}
        for group in graph.variables:
            for key, given in zip(group.keys.tolist(), group.values, strict=True):
                vertex, row = model.vertex(group.kind), model.turned(group.kind, given)
                vertex.set_id(len(vertices))
                vertex.set_fixed(group.fixed)
                vertex.set_estimate_data(row)
                optimizer.add_vertex(vertex)
                vertices[key] = vertex, row
        edges = []
        for group in graph.factors:
            for ends, z, omega in zip(group.keys.tolist(), group.measured, symmetric(group.information), strict=True):
                edge = model.edge(group.kind, z, [vertices[key][0] for key in ends])
                edge.set_information(omega)
                optimizer.add_edge(edge)
                edges.append(edge)

        def read() -> tuple[Variables, ...]:
            rows = {key: np.array(vertex.get_estimate_data(), float) for key, (vertex, _) in vertices.items()}
            return tuple(
                g._replace(values=np.array([model.turned(g.kind, rows[key]) for key in g.keys.tolist()]))
                for g in graph.variables
            )

        def run() -> End:
            if not optimizer.initialize_optimization():
                raise Failed("initialize_optimization failed")
            done = optimizer.optimize(_MOST)
            if done <= 0:
                raise Failed("optimize failed: the system is not positive definite")
            return End(done, read)

        def reset() -> None:
            for vertex, row in vertices.values():
                vertex.set_estimate_data(row)

        return Prepared(run, reset, (algorithm, enough, edges))

    return prepare


@dataclass(frozen=True, slots=True)
class BatchSolver:
    """A column.  package: what its version is that of."""

    name: str
    package: str
    prepare: Callable[[Batch], Prepared]

    @property
    def version(self) -> str:
        return metadata.version(self.package)

    @property
    def missing(self) -> bool:
        return find_spec(self.package) is None


OURS, OURS_ALONE, PEER = "factorbus", "factorbus, this start", "gtsam lm"
BATCH_SOLVERS = (
    BatchSolver(OURS, "factorbus", ours("best")),
    BatchSolver(OURS_ALONE, "factorbus", ours("values")),
    BatchSolver(PEER, "gtsam", gtsam_optimizer("lm")),
    BatchSolver("gtsam lm, qr", "gtsam", gtsam_optimizer("lm-qr")),
    BatchSolver("gtsam gn", "gtsam", gtsam_optimizer("gn")),
    BatchSolver("g2o lm", "g2opy", g2o_optimizer("lm")),
    BatchSolver("g2o gn", "g2opy", g2o_optimizer("gn")),
)


def chi2_at_end(graph: Batch, end: End) -> float:
    """χ² there, in g2o's convention."""
    return chi2_at(graph.variables, graph.factors, end.values())
