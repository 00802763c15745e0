"""A step whose bound asks for another round takes residuals anew and keeps R; the next need not ask again.  MATH §9.6

The judge of χ² is the mode "all-batch", which shares no step with the default.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pytest
from naive.dense_least_squares import full
from naive.solver_parts import graph_in
from naive.tree_records import tree_of

from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver, StepReport
from factorbus.solver.divergence import copied
from factorbus.solver.kernels.bayes_tree import layout as tl
from factorbus.solver.kernels.model import layout as at
from factorbus.solver.kernels.model.linearize import evaluate_apart
from factorbus.solver.kernels.model.sizes import information_at, residual_dim

DEFAULT = Options()
BATCH = Options(mode="all-batch", batch_tolerance=1e-10, max_iterations=50)


class Taken(NamedTuple):
    """A step of a drive: the solver after it, its report, whether a chord step ended it, and χ² of the optimum."""

    solver: Solver
    report: StepReport
    ended_by_chord: bool
    optimum: float


def drive(world: str, poses: int, seed: int, judged: bool = True, options: Options = DEFAULT) -> Iterator[Taken]:
    """The steps of a drive."""
    solver, batch = Solver(options), Solver(BATCH)
    for step in WORLDS[world](poses, seed):
        solver.stage(step.batch)
        report, optimum = solver.step(), 0.0
        if judged:
            batch.stage(step.batch)
            optimum = batch.step().chi2
        state = tree_of(solver).state
        ended = state[tl.S_CHORDS] == 1 and state[tl.S_ROUNDS] == 1
        yield Taken(solver, report, bool(ended), optimum)


@pytest.mark.parametrize(("world", "poses", "seed"), [("sphere", 130, 3), ("manhattan", 450, 7)])
def test_a_chord_step_ends_a_step_near_the_optimum_without_relinearizing(world: str, poses: int, seed: int) -> None:
    ended = 0
    for taken in drive(world, poses, seed):
        if taken.ended_by_chord:
            ended += 1
            assert taken.report.converged
            assert taken.report.relinearized == 0
            assert taken.report.because == "residuals taken anew in a chord step"
            assert taken.report.chi2 <= 1.0005 * taken.optimum
    assert ended > 2


def test_its_errors_are_counted_from_there() -> None:
    """It ends within its bound, and an odometry step after it asks for nothing."""
    after, chord = 0, False
    for taken in drive("manhattan", 600, 7, judged=False):
        state, totals = tree_of(taken.solver).state, tree_of(taken.solver).totals
        assert not taken.ended_by_chord or totals[tl.T_ERROR] <= totals[tl.T_ALLOWED]
        if chord and taken.report.new_factors <= taken.report.new_variables:
            after += 1
            assert taken.report.relinearized == 0
            assert state[tl.S_CHORDS] == 0
        chord = taken.ended_by_chord
    assert after > 2


@pytest.mark.parametrize(("world", "poses", "seed"), [("sphere", 130, 3), ("manhattan", 300, 7)])
def test_the_tree_solves_the_corrected_models(world: str, poses: int, seed: int) -> None:
    """Σ J₀ᵀ Ω (r₀ + J₀ δ + m) is zero, as back-substitution leaves nothing undone here."""
    checked = 0
    for taken in drive(world, poses, seed, judged=False, options=Options(wildfire_threshold=0.0)):
        if taken.ended_by_chord:
            checked += 1
            of_models, uncorrected = gradients(taken.solver)
            assert np.abs(of_models).max() < 1e-8
            assert np.abs(uncorrected).max() > 1e-2
    assert checked > 1


def test_a_copy_goes_on_from_a_chord_step_to_the_same_bits() -> None:
    other: Solver | None = None
    steps = [step.batch for step in WORLDS["sphere"](130, 3)]
    solver = Solver()
    for k, batch in enumerate(steps):
        for each in (solver, other):
            if each is not None:
                each.stage(batch)
                each.step()
        if other is None and tree_of(solver).state[tl.S_CHORDS]:
            other, since = copied(solver), k
    assert other is not None
    assert since < len(steps) - 10
    for one, two in zip(solver.estimate(), other.estimate(), strict=True):
        np.testing.assert_array_equal(one.values, two.values)


def gradients(solver: Solver) -> tuple[np.ndarray, np.ndarray]:
    """Of the linear models at δ: as chord steps have corrected them, and as they were linearized."""
    graph, tree = graph_in(solver), tree_of(solver)
    delta, out = tree.scalars[0], np.zeros((2, int(graph.counts[at.SCALARS])))
    for f in range(solver.factor_count):
        kind = int(graph.fac[f, at.F_KIND])
        dim = residual_dim(kind)
        r, A, B = np.zeros(at.R_SIZE), np.zeros((6, 6)), np.zeros((6, 6))
        evaluate_apart(f, graph.var, graph.fac, tree.lin[0], graph.payload, r, A, B)
        p = int(graph.fac[f, at.F_AT] + information_at(kind))
        weight = full(graph.payload[p : p + dim * (dim + 1) // 2])
        both = zip(graph.fac[f, at.F_I : at.F_J + 1], (A, B), strict=True)
        ends = [(int(graph.var[v, at.V_SCALAR]), J[:dim, :dim]) for v, J in both if graph.var[v, at.V_SCALAR] >= 0]
        model = r[:dim] + sum(J @ delta[start : start + dim] for start, J in ends)
        missed = missed_of(tree, f, kind, A, graph)
        for row, residual in enumerate((model + missed, model)):
            for start, J in ends:
                out[row, start : start + dim] += J.T @ weight @ residual
    return out[0], out[1]


def missed_of(tree, f: int, kind: int, A: np.ndarray, graph) -> np.ndarray:
    """m of factor f, in the frame of its residual."""
    row = tree.factor_errors[f]
    if row[tl.E_FORM] < tl.CORRECTED:
        return np.zeros(residual_dim(kind))
    if kind == at.BETWEEN_SE3:
        return row[tl.E_MISSED : tl.E_MISSED + 6]
    x, y = row[tl.E_MISSED : tl.E_MISSED + 2]
    c, s = tree.turns[graph.fac[f, at.F_I], [tl.U_COS, tl.U_SIN]]
    return np.append(-A[:2, :2] @ (c * x + s * y, c * y - s * x), 0.0)
