"""The linear model of an inertial factor is corrected by what it misses: in a chord step, and where a factor comes to
poses that have moved since they were linearized.  MATH (9.35)
"""

import numpy as np
import pytest
from bench.drives_with_imu import drive_of
from bench.inertial_solvers import Ours
from naive.dense_least_squares import full
from naive.random_imu import imu_steps
from naive.solver_parts import NEVER_RELINEARIZES, graph_in, row_count
from naive.tree_records import tree_of

from factorbus.proto.inertial import ImuForm
from factorbus.solver import Options, Solver
from factorbus.solver.graph.factor_rows import is_first
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.bayes_tree.correct_inertial import correct_inertial, is_inertial_and_plain
from factorbus.solver.kernels.bayes_tree.hessian_room import jacobian_at, last_of_hessian
from factorbus.solver.kernels.bayes_tree.records import tree_at
from factorbus.solver.kernels.jit.compile import I64, part
from factorbus.solver.kernels.model.candidates import evaluate_many
from factorbus.solver.kernels.model.factor_rows import rows_of
from factorbus.solver.kernels.model.records import graph_at

FORMS = {
    "samples": None,
    "mount": ImuForm(1, mount=True),
    "gravity": ImuForm(1, gravity=True),
    "integrated": ImuForm(0),
}


@part
def correct(f: int, graph_table: I64, tree_table: I64) -> bool:
    """Factor f, if it is one that can be."""
    graph, tree = graph_at(graph_table), tree_at(tree_table)
    if not is_inertial_and_plain(f, graph, tree):
        return False
    correct_inertial(f, graph, tree)
    return True


@pytest.mark.parametrize("form", FORMS)
def test_a_corrected_model_has_the_residual_of_the_estimate_and_the_gradient_of_that(form: str) -> None:
    solver, seen = Solver(Options.of(**NEVER_RELINEARIZES)), 0
    for batch in imu_steps(3, of_form=FORMS[form]):
        solver.stage(batch)
        solver.step()
    graph, tree = graph_in(solver), tree_of(solver)
    for f in np.flatnonzero(is_first(graph.fac[: row_count(solver)])).tolist():
        before = tree.hessian.copy()
        if not correct(f, graph.array_table, tree.array_table):
            continue
        dim, ends = graph.kind_of(f).dim, graph.ends_of(f)
        dims = [end.dim for end in graph.kind_of(f).connects]
        k = int(jacobian_at(f, graph.var, graph.fac, tree.link))
        J = tree.hessian[k + dim : k + dim + dim * sum(dims)].reshape(dim, sum(dims))
        starts = graph.var[ends, 2].tolist()
        delta = np.concatenate([tree.scalars[0][s : s + d] for s, d in zip(starts, dims, strict=True)])
        model = tree.hessian[k : k + dim]
        r, now, root = np.empty(dim), np.empty(J.shape), np.empty((dim, dim))
        evaluate_many(f, graph.array_table, graph.values, r, now, root)
        weight = full_information(graph, f, dim)
        linear = model + J @ delta
        # As samples are expanded.
        assert linear @ linear == pytest.approx(r @ weight @ r, rel=1e-4, abs=1e-8)
        gradient, c = -J.T @ model, 0
        for n, d in enumerate(dims):
            last = int(last_of_hessian(f + max(n - 1, 0), graph.var, graph.fac, tree.link))
            start = last - d - (dims[1] if n == 0 else 0)
            np.testing.assert_allclose(tree.hessian[start : start + d], gradient[c : c + d], rtol=1e-9, atol=1e-9)
            c += d
        assert tree.hessian[last_of_hessian(f, graph.var, graph.fac, tree.link)] == pytest.approx(model @ model)
        # Nothing else of it is written.
        end = int(last_of_hessian(f + int(rows_of(f, graph.fac)) - 1, graph.var, graph.fac, tree.link))
        np.testing.assert_array_equal(tree.hessian[end + 1 + dim :], before[end + 1 + dim :])
        seen += bool(np.abs(delta).max() > 1e-3)
    assert seen > 1


def full_information(graph, f: int, dim: int) -> np.ndarray:
    """Ω."""
    p = int(graph.fac[f, 3] + graph.kind_of(f).information_at)
    return full(graph.payload[p : p + dim * (dim + 1) // 2])


def test_in_a_drive_what_comes_after_a_position_asks_for_nothing() -> None:
    """A step with samples alone, from poses that a position has moved, leaves the estimate where it is."""
    ours, chords = Ours(drive_of("kitti", 160)), 0
    solver, drive = ours._solver, ours._drive
    for n in range(drive.steps):
        solver.stage(ours._drafted(n).batch())
        report = solver.step()
        chords += int(tree_of(solver).state[tl.S_CHORDS])
        assert report.converged
        if n and not drive.used[n]:
            assert report.iterations == 1
            assert report.relinearized == 0
            assert report.chi2 == pytest.approx(report.chi2_before, rel=1e-6, abs=1e-9)
        elif n:
            chi2, best = ours.chi2_and_optimum()
            assert chi2 - best <= 1e-3 * max(best, 1.0)
    assert chords > 0
