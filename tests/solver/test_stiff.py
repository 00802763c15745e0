"""Factors so stiff that R is rounding beside them: each step comes to the optimum all the same.  MATH (6.3), (6.4)"""

import math
from collections.abc import Iterator

import numpy as np
import pytest
from naive.solver_parts import graph_in, stepper_in, system_in
from scipy.spatial.transform import Rotation
from solver.test_converged import finish, put, rig_drive
from solver.test_decrement import drive_of, normal_equations

from factorbus.client import Draft
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import symbol
from factorbus.solver import Options, Solver
from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.divergence import copied
from factorbus.solver.errors import Underconstrained
from factorbus.solver.kernels.model.multiply_hessian import multiply_hessian
from factorbus.solver.modes import MODES

PLANE, SPACE = 2, 3
SIGMAS = {PLANE: np.array([0.1, 0.1, 0.02]), SPACE: np.array([0.1] * 3 + [0.02] * 3)}
EVERY, BACK = 5, 37  # poses with a second one on them; poses from loop to loop
DRIVES = [(mode, 1e-7, 0.1) for mode in MODES] + [
    (mode, *given) for mode in ("auto", "all-batch") for given in ((1e-5, 1e5), (1e-6, 0.1), (1e-7, 1e5), (1e-8, 1e5))
]
RIGID = 1e-4  # m, rad: as stiff as makes no difference here, and no rounding


def motion(space: int, *numbers: float) -> np.ndarray:
    """(4, 4) of x, y, yaw, or of x, y, z and a rotation vector."""
    place, turn = (numbers[:3], numbers[3:]) if space == SPACE else ((*numbers[:2], 0.0), (0.0, 0.0, numbers[2]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), place
    return T


def measured(space: int, T: np.ndarray) -> list[float]:
    """The value of a pose as a draft takes it."""
    turn = Rotation.from_matrix(T[:3, :3])
    return [*T[:3, 3], *turn.as_quat()] if space == SPACE else [*T[:2, 3], turn.as_rotvec()[2]]


def rig(space: int, poses: int, seed: int, prior: float, stiff: float) -> Iterator[Draft]:
    """A drive whose every fifth pose has a second one on it, by which it is measured from the one before, too."""
    rng, sigmas = np.random.default_rng([seed, space]), SIGMAS[space]
    add, between = f"se{space}", f"between_se{space}"
    link = motion(space, *([0.3, 0.1, 0.2, 0.1, -0.2, 0.4] if space == SPACE else [0.3, 0.1, 0.4]))
    true, linked = [np.eye(4)], []

    def join(draft: Draft, a: str, b: str, T: np.ndarray) -> None:
        noise = motion(space, *rng.normal(0, 0.5 * sigmas))
        getattr(draft, between)(a, b, measured(space, T @ noise), sigmas=sigmas)

    for i in range(poses):
        draft = Draft()
        if i == 0:
            getattr(draft, add)("x0", measured(space, true[0]))
            getattr(draft, f"prior_se{space}")("x0", measured(space, true[0]), sigmas=[prior] * sigmas.size)
        else:
            turn = rng.normal() * 0.1 if i % 20 else math.pi / 2
            lean = 0.02 * rng.normal(size=2)
            step = motion(space, *([1, 0, 0, *lean, turn] if space == SPACE else [1, 0, turn]))
            true.append(true[-1] @ step)
            join(getattr(draft, add)(f"x{i}"), f"x{i - 1}", f"x{i}", step)
        if i % EVERY == 0:
            getattr(draft, add)(f"r{i}")
            getattr(draft, between)(f"x{i}", f"r{i}", measured(space, link), sigmas=[stiff] * sigmas.size)
            for j in linked[-1:]:
                join(draft, f"r{j}", f"r{i}", np.linalg.inv(true[j] @ link) @ true[i] @ link)
            linked.append(i)
        if i and i % BACK == 0:
            j = int(rng.integers(0, max(i - 20, 1)))
            join(draft, f"x{j}", f"x{i}", np.linalg.inv(true[j]) @ true[i])
        yield draft


@pytest.mark.parametrize("space", [PLANE, SPACE])
@pytest.mark.parametrize(("mode", "stiff", "prior"), DRIVES)
def test_every_step_comes_to_the_optimum(mode: str, stiff: float, prior: float, space: int) -> None:
    """At pose 1,188 of such a drive one with links of 1e-7 m was refused, as its estimate had left all numbers."""
    solver, plain = Solver(Options(mode=mode)), Solver(Options(mode="inc-l"))
    for given, ordinary in zip(rig(space, 120, 4, prior, stiff), rig(space, 120, 4, prior, RIGID), strict=True):
        report, optimum = put(solver, given), put(plain, ordinary).chi2
        assert report.converged
        assert report.chi2 == pytest.approx(optimum, rel=1e-3, abs=1e-6)
    while solver.unfinished:
        solver.step()
    assert solver.chi2() == pytest.approx(plain.step(settle=True).chi2, rel=1e-4)


@pytest.mark.parametrize("stiff", [1e-5, 1e-6, 1e-7])
def test_two_thousand_poses_with_a_second_one_on_every_tenth_are_taken_to_the_batch_optimum(stiff: float) -> None:
    """Behind a prior of variance 1e10; a link that contradicts nothing adds nothing to the optimum of the drive."""
    solver = rig_drive(stiff, 2000)
    finish(solver)
    assert solver.chi2() == pytest.approx(134.313023, rel=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_it_goes_on_to_the_bit_from_its_state(mode: str) -> None:
    solver, drafts = Solver(Options(mode=mode)), list(rig(PLANE, 120, 5, 1e5, 1e-7))
    for draft in drafts[:100]:
        put(solver, draft)
    other = copied(solver)
    for draft in drafts[100:]:
        assert put(solver, draft).chi2 == put(other, draft).chi2
    for here, there in zip(solver.estimate(), other.estimate(), strict=True):
        assert here.values.tobytes() == there.values.tobytes()


@pytest.mark.parametrize("mode", MODES)
def test_a_weak_first_prior_is_no_matter_once_the_map_is_known_better(mode: str) -> None:
    """Every loop solved all of the map by conjugate gradients for ever after."""
    solver, plain = Solver(Options(mode=mode)), Solver(Options(mode="inc-l"))
    drives = rig(PLANE, 120, 4, 1e6, 1e-3), rig(PLANE, 120, 4, 0.1, 1e-3)
    for n, (given, ordinary) in enumerate(zip(*drives, strict=True)):
        if n == 80:
            assert is_rounded(solver)
            given.prior_se2("x0", [0.0, 0.0, 0.0], sigmas=[0.1] * 3)
        report, optimum = put(solver, given), put(plain, ordinary).chi2
        assert not report.converged or report.chi2 == pytest.approx(optimum, rel=1e-3, abs=1e-6)
    solver.step(settle=True)
    assert not is_rounded(solver)
    assert solver.chi2() == pytest.approx(plain.step(settle=True).chi2, rel=1e-4)


@pytest.mark.parametrize("mode", MODES)
def test_what_nothing_holds_is_refused_beside_stiff_links(mode: str) -> None:
    solver = Solver(Options(mode=mode))
    for draft in rig(PLANE, 60, 6, 1e5, 1e-7):
        put(solver, draft)
    before = [group.values.tobytes() for group in solver.estimate()]
    poses = {key: row for g in solver.estimate() for key, row in zip(g.keys.tolist(), g.values, strict=True)}
    point, seen_from = np.array([5.0, 5.0]), (symbol("x", 3), symbol("x", 30))
    towards = [math.atan2(*(point - poses[key][:2])[::-1]) - poses[key][2] for key in seen_from]
    draft = Draft().point2("l0", (4.9, 5.1)).bearing_se2("x3", "l0", towards[0], sigmas=0.01)
    with pytest.raises(Underconstrained):
        put(solver, draft)
    assert [group.values.tobytes() for group in solver.estimate()] == before
    put(solver, draft.bearing_se2("x30", "l0", towards[1], sigmas=0.01))
    found = next(group.values[0] for group in solver.estimate() if symbol("l", 0) in group.keys)
    np.testing.assert_allclose(found, point, atol=1e-3)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("stiff", [1e-4, 1e-6, 1e-7, 1e-8])
def test_two_new_poses_on_a_stiff_link_are_held_by_what_they_see(stiff: float, mode: str) -> None:
    """Each sees one point, which leaves it free; Λ in doubles does not show that the link holds them."""
    solver, known = Solver(Options(mode=mode)), Draft().se2("x0", (0.0, 0.0, 0.0))
    known.prior_se2("x0", (0.0, 0.0, 0.0), sigmas=[0.1, 0.1, 0.02])
    for k, y in enumerate((-3.0, -1.0)):
        known.point2(f"l{k}").landmark_se2("x0", f"l{k}", (3.0 + k, y), sigmas=[0.1, 0.1])
    put(solver, known)
    both = Draft().se2("y0", (1.0, 0.0, 0.0)).se2("y1", (1.5, 0.0, 0.0))
    both.between_se2("y0", "y1", (0.5, 0.0, 0.0), sigmas=[stiff] * 3)
    both.landmark_se2("y0", "l0", (2.0, -3.0), sigmas=[0.1, 0.1])
    alone = copied(solver)
    put(solver, both.landmark_se2("y1", "l1", (2.5, -1.0), sigmas=[0.1, 0.1]))
    assert solver.chi2() == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(Underconstrained):
        put(alone, Draft().se2("y0", (1.0, 0.0, 0.0)).landmark_se2("y0", "l0", (2.0, -3.0), sigmas=[0.1, 0.1]))


@pytest.mark.parametrize("space", [PLANE, SPACE])
@pytest.mark.parametrize(("mode", "stiff", "prior"), [("auto", 1e-7, 0.1), ("inc-l", 1e-7, 0.1), ("auto", 1e-8, 1e5)])
def test_covariances_are_those_of_links_that_are_no_rounding(mode: str, stiff: float, prior: float, space: int) -> None:
    """σ of a pose was half of what it is, and a 400th where a weak prior holds the map."""
    joint = []
    for of, sigma in ((mode, stiff), ("inc-l", RIGID)):
        solver = Solver(Options(mode=of))
        for draft in rig(space, 120, 4, prior, sigma):
            put(solver, draft)
        graph, source = graph_in(solver), solver.covariances
        ends = np.array([graph.find(symbol("x", n)) for n in (119, 50)])
        joint.append(CovarianceBlocks(source.try_view() or source.factored()).joint(ends))
    sigmas = [np.sqrt(each.diagonal()) for each in joint]
    np.testing.assert_allclose(sigmas[0], sigmas[1], rtol=2e-2)
    correlations = [each / np.outer(of, of) for each, of in zip(joint, sigmas, strict=True)]
    np.testing.assert_allclose(correlations[0], correlations[1], atol=2e-2)


@pytest.mark.parametrize("name", ["plane", "space", "mounted"])
def test_the_product_is_that_of_dense_matrices(name: str) -> None:
    solver = Solver()
    for batch in drive_of(name):
        stage(solver, batch)
    graph = graph_in(solver)
    Lambda, _ = normal_equations(solver, graph.values)
    x = np.random.default_rng(1).normal(size=len(Lambda))
    out = np.ones(x.size)
    multiply_hessian(graph.array_table, x, out)
    np.testing.assert_allclose(out - 1.0, Lambda @ x, rtol=1e-9, atol=1e-9 * np.abs(Lambda).max())


def is_rounded(solver: Solver) -> bool:
    stepper = stepper_in(solver)
    return stepper.tree.raised if isinstance(stepper, TreeSteps) else system_in(solver).rounded


def stage(solver: Solver, batch: Batch) -> None:
    solver.stage(batch)
    solver.step()
