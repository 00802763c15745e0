"""Where a piece of map turns as a whole, what its factors miss by that is counted: (9.21), for kinds of all sorts."""

import numpy as np
import pytest
from naive.own_formulas import OWN
from naive.solver_parts import graph_in, row_count
from naive.tree_records import tree_of

from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver
from factorbus.solver.graph.factor_rows import is_first
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.exact_error import exact_error
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.model.records import graph_at

POSES = 200
WEAK = 1e-4  # of the information: what is measured is far better than it says, and χ² next to nothing
# Of the Σ error² up to which a step has converged.
LEAST = 0.003
SIGHTED, EVERY = 8, 40  # landmarks of a stretch of so many poses


@pytest.mark.parametrize("seed", [3, 4])
def test_own_kinds_of_two_poses(seed: int) -> None:
    """Turned by loop closures of streets."""
    usual, own = Solver(Options()), Solver(Options())
    for batch in drive(seed):
        usual.stage(batch)
        usual.step()
        values = dict[int, np.ndarray]()
        for group in usual.estimate():
            values.update(zip(group.keys.tolist(), group.values, strict=True))
        variables = [g._replace(values=np.array([values[k] for k in g.keys.tolist()])) for g in batch.variables]
        factors = [group._replace(kind=OWN[group.kind].name) for group in batch.factors]
        own.stage(Batch(tuple(variables), tuple(factors)))
        if own.step().converged:
            assert_all_is_counted(own)


@pytest.mark.parametrize("kind", ["range_se2", "bearing_se2"])
@pytest.mark.parametrize("seed", [1, 3])
def test_ranges_and_bearings_of_landmarks(kind: str, seed: int) -> None:
    """A hundred times as far away as the next pose is, each seen from a stretch of the way."""
    rng, solver = np.random.default_rng(seed), Solver(Options())
    truth = [step.truth[0].values[-1] for step in manhattan(POSES, seed)]
    for k, batch in enumerate(drive(seed)):
        pose = int(batch.variables[0].keys[-1])
        if k % EVERY == 0:
            points, keys = truth[k][:2] + rng.uniform(-80, 80, (SIGHTED, 2)), 1000 + k + np.arange(SIGHTED)
            seen = np.array([where(truth[k], point) for point in points]) + rng.normal(0, 1, points.shape)
            ends, weak = np.stack((np.full(SIGHTED, pose), keys), 1), np.tile([[1.0, 0.0, 1.0]], (SIGHTED, 1))
            new = Batch((Variables("point2", keys),), (Factors("landmark_se2", ends, seen, WEAK * weak),))
            batch = Batch((*batch.variables, *new.variables), (*batch.factors, *new.factors))
        n = int(rng.integers(SIGHTED))
        u, v = where(truth[k], points[n])
        z, weight = (np.hypot(u, v), 2500.0) if kind == "range_se2" else (np.arctan2(v, u), 1e4)
        sight = Factors(kind, np.array([[pose, keys[n]]]), np.array([[z]]), WEAK * np.array([[weight]]))
        solver.stage(Batch(batch.variables, (*batch.factors, sight)))
        if solver.step().converged:
            assert_all_is_counted(solver)


def drive(seed: int) -> list[Batch]:
    """Streets, of which all measurements weigh less than they could."""
    out = []
    for step in manhattan(POSES, seed):
        weak = (group._replace(information=WEAK * group.information) for group in step.batch.factors)
        out.append(step.batch._replace(factors=tuple(weak)))
    return out


def where(pose: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The point in the frame of the pose."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, s], [-s, c]]) @ (point - pose[:2])


def assert_all_is_counted(solver: Solver) -> None:
    """Σ error² of all factors whose error is computed, as it was counted, is that of the estimate."""
    graph, tree = graph_in(solver), tree_of(solver)
    least = LEAST * tree.totals[tl.T_ALLOWED]
    gap = 0.0
    for f in np.flatnonzero(is_first(graph.fac[: row_count(solver)])).tolist():
        if tree.link[f, tl.L_KIND] >= tl.EXACT:
            error, force, _ = error_at(f, graph.array_table, tree.array_table)
            gap += (error + force) ** 2 - tree.factor_errors[f, tl.E_ERROR]
    assert gap <= least


@part
def error_at(f: int, graph_table: I64, tree_table: I64) -> tuple[float, float, float]:
    """Of factor f, with the arrays that the tables are of."""
    return exact_error(f, graph_at(graph_table), tree_at(tree_table))
