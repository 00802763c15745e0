"""What a report says of its estimate is true at every step, in every mode; what has not converged goes on.  MATH §9.6

The judge of χ² is the dense twin, of the optimum the mode "all-batch", which shares no step with the default.
"""

import math
from collections.abc import Callable, Iterator
from functools import cache

import numpy as np
import pytest
from naive.dense_least_squares import DenseGraph
from naive.random_graphs import camera_steps

from factorbus.client import Draft
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import symbol
from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver, StepReport
from factorbus.solver.bayes_tree.steps import TreeSteps
from factorbus.solver.divergence import copied
from factorbus.solver.starts.batch import solve_batch

X = symbol("x", 0), symbol("x", 10**6)
FLOOR = 1e-3  # χ² of which a share means nothing
MODES = ["bayes-tree", "inc-l", "inc-l-b10", "all-batch"]
BATCH = Options(mode="all-batch", batch_tolerance=1e-10, max_iterations=50)


@pytest.mark.parametrize("world", ["manhattan", "city_trees", "sphere"])
@pytest.mark.parametrize("seed", [21, 22])
def test_at_every_step_the_estimate_is_the_batch_answer_or_says_that_it_is_not(world: str, seed: int) -> None:
    solver, batch, open_steps, poses = Solver(), Solver(BATCH), 0, 300
    for step in WORLDS[world](poses, seed):
        for each in (solver, batch):
            each.stage(step.batch)
        report, optimum = solver.step(), batch.step().chi2
        assert report.chi2 == pytest.approx(solver.chi2(), rel=1e-9, abs=1e-9)
        open_steps += not report.converged
        assert not report.converged or report.chi2 + FLOOR <= 1.001 * (optimum + FLOOR)
    assert open_steps <= 0.01 * poses


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("world", ["manhattan", "city_trees", "sphere"])
def test_chi2_before_and_after_are_those_of_the_values(world: str, mode: str) -> None:
    """Before: at the values before the step, the new factors at the first values of the new variables."""
    options = Options(mode=mode, initialize_locally=False)
    solver, before = Solver(options), DenseGraph()
    for step in WORLDS[world](80, 5):
        solver.stage(step.batch)
        before.add(step.batch)
        before.put(solver.estimate())  # staged: new variables have their first values
        report = solver.step()
        assert report.chi2_before == pytest.approx(before.chi2(), rel=1e-7, abs=1e-9)
        before.put(solver.estimate())
        assert report.chi2 == pytest.approx(before.chi2(), rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_newest_pose_is_where_its_odometry_wants_it(seed: int) -> None:
    """A loop moves the newest pose; the odometry that comes next is linearized there.  It was off by up to 20 σ."""
    solver, batch = Solver(), Solver(BATCH)
    for step in WORLDS["manhattan"](700, seed):
        for each in (solver, batch):
            each.stage(step.batch)
            each.step()
        newest = [factors for factors in step.batch.factors if factors.kind == "between_se2"]
        if newest:
            told, best = (length_of(each, newest[0]) for each in (solver, batch))
            assert abs(told - best) < 0.25


def length_of(solver: Solver, factors) -> float:
    """√rᵀΩr of the first of the factors, which is the odometry."""
    twin, ends = DenseGraph(), set(factors.keys[0].tolist())
    one = type(factors)(factors.kind, factors.keys[:1], factors.measured[:1], factors.information[:1])
    for group in solver.estimate():
        kept = [k for k, key in enumerate(group.keys.tolist()) if key in ends]
        if kept:
            part = type(group)(group.kind, group.keys[kept], group.values[kept], group.fixed)
            twin.add(Batch((part,), ()))
            twin.put([part])
    twin.add(Batch((), (one,)))
    return math.sqrt(twin.chi2())


@pytest.mark.parametrize("seed", [6000, 6008, 6018, 6025, 6033, 6034])
def test_cameras_that_lose_pixels_have_converged_where_they_say_so(seed: int) -> None:
    """Under Huber's loss, points near and far: the Jacobian changes more than the residual does, MATH (9.31)."""
    solver, told = Solver(), 0
    for batch in camera_steps(seed, loss="huber"):
        solver.stage(batch)
        report = solver.step()
        settled = copied(solver)
        for _ in range(5):
            settled.step(settle=True)
        told += report.converged
        assert not report.converged or report.chi2 + FLOOR <= 1.001 * (settled.chi2() + FLOOR)
    assert told > 1


@pytest.mark.parametrize("angle_deg", [10, 20, 40, 60, 90])
def test_a_turn_seen_from_a_fixed_pose_in_space_counts(angle_deg: float) -> None:
    """Nothing turns at the first end: what the linear model misses is all of the second one, MATH (9.26)."""
    solver, turn = Solver(Options(max_rounds=1)), math.radians(angle_deg) / 2
    sigmas = (0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
    put(solver, Draft().se3("y0", (0, 0, 0, 0, 0, 0, 1), fixed=True))
    put(solver, Draft().se3("y1").between_se3("y0", "y1", (1, 0, 0, 0, 0, 0, 1), sigmas=sigmas))
    other = Draft().se3("y2", (0, 0, 0, 0, 0, 0, 1), fixed=True)
    seen = (1, 0, 0, 0, 0, math.sin(turn), math.cos(turn))
    told = put(solver, other.between_se3("y2", "y1", seen, sigmas=tuple(2 * sigma for sigma in sigmas)))
    optimum = settled_apart(solver)
    assert not told.converged or told.chi2 <= 1.001 * optimum
    finish(solver)
    assert solver.chi2() == pytest.approx(optimum, rel=1e-6)


@pytest.mark.parametrize("mode", ["auto", "inc-l-b10", "inc-l-b100"])
@pytest.mark.parametrize(("drift_deg", "optimum"), [(36, 0.437877), (90, 2.736733), (120, 4.865304), (150, 7.602037)])
def test_a_loop_that_turns_most_of_the_map(drift_deg: float, optimum: float, mode: str) -> None:
    solver, report = ring(drift_deg, mode)
    assert not report.converged or report.chi2 <= 1.001 * optimum
    finish(solver)
    assert solver.chi2() == pytest.approx(optimum, rel=1e-6)


def test_a_mode_that_does_not_come_that_far_in_a_step_says_so() -> None:
    solver, report = ring(90, "inc-l", max_nonmonotone_steps=0)
    assert not report.converged
    assert solver.unfinished
    assert report.chi2 == pytest.approx(solver.chi2(), rel=1e-9)
    assert solver.step().chi2 < report.chi2


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("poses", [200, 1000])
@pytest.mark.parametrize("drift_deg", [36, 90, 150])
def test_every_mode_ends_at_the_optimum_of_such_a_loop(drift_deg: float, poses: int, mode: str) -> None:
    """Damped steps go around a hill there, of which the step over it is the first: in hundreds."""
    solver, _ = ring(drift_deg, mode, poses)
    finish(solver, 3)
    assert solver.chi2() == pytest.approx(ring_optimum(drift_deg, poses), rel=1e-6)


@pytest.mark.parametrize(("poses", "optimum"), [(5000, 60.9192), (8000, 97.7466), (20000, 245.0561)])
def test_many_loops_that_contradict_a_long_drive_mildly_end_at_the_optimum(poses: int, optimum: float) -> None:
    """Over several hills, or one of 33 steps.  GTSAM's Gauss-Newton from odometry: 60.920 and 245.061 with 5,000 and
    20,000 poses, in its residual; damped steps were at 278 after 375 of them."""
    drive = Draft().se2(X[0], (0, 0, 0), fixed=True)
    for i in range(1, poses):
        drive.se2(X[0] + i).between_se2(X[0] + i - 1, X[0] + i, (1, 0, 0.01), sigmas=(0.1, 0.1, 0.05))
    loops = Draft()
    for i in range(0, poses - 60, 40):
        loops.between_se2(X[0] + i, X[0] + i + 50, (47, 12, 0.5), sigmas=(1, 1, 0.5))
    solver = Solver()
    put(solver, drive)
    assert put(solver, loops).converged
    finish(solver, 3)
    assert solver.chi2() == pytest.approx(optimum, rel=1e-5)
    innocent = put(solver, Draft().se2("q0").between_se2(X[0] + 100, "q0", (1, 0, 0), sigmas=(0.1, 0.1, 0.05)))
    assert innocent.converged
    assert innocent.strategy != "batch"


@cache
def ring_optimum(drift_deg: float, poses: int) -> float:
    """χ² of the batch, from several starts."""
    return solve_batch(*ring(drift_deg, "all-batch", poses)[0].graph()).chi2


def ring(drift_deg: float, mode: str = "auto", poses: int = 1000, **options: int) -> tuple[Solver, StepReport]:
    """Odometry that turns by so much too far on its way round, and the loop that closes it."""
    solver, turn = Solver(Options.of(mode=mode, **options)), (2 * math.pi + math.radians(drift_deg)) / (poses - 1)
    put(solver, Draft().se2("x0", (0, 0, 0), fixed=True))
    for i in range(1, poses):
        edge = Draft().se2(f"x{i}")
        put(solver, edge.between_se2(f"x{i - 1}", f"x{i}", (1, 0, turn), sigmas=(0.05, 0.05, 0.03)))
    return solver, put(solver, Draft().between_se2(f"x{poses - 1}", "x0", (0, 0, 0), sigmas=(0.1, 0.1, 0.05)))


@pytest.mark.parametrize("mode", ["auto", "inc-l", "inc-l-b10"])
@pytest.mark.parametrize("space", [False, True], ids=["plane", "space"])
@pytest.mark.parametrize("angle_deg", [60, 90, 120, 150, 178, 180])
def test_two_robots_meet_at_any_angle(space: bool, angle_deg: float, mode: str) -> None:
    solver, report = meeting(space, angle_deg, mode)
    optimum = settled_apart(solver)
    assert not report.converged or report.chi2 + FLOOR <= 1.001 * (optimum + FLOOR)
    finish(solver)
    assert solver.chi2() == pytest.approx(optimum, rel=1e-6, abs=1e-9)
    assert optimum < 1.0


def test_a_step_that_would_raise_chi2_is_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    _, report = meeting(True, 178)
    assert "would have risen" in report.because
    assert report.chi2 <= report.chi2_before
    # Nothing else keeps it from rising.
    monkeypatch.setattr(TreeSteps, "_batch", lambda *_: None)
    _, raised = meeting(True, 178)
    assert raised.chi2 > raised.chi2_before or raised.chi2 > 1e3 * report.chi2


def meeting(space: bool, angle_deg: float, mode: str = "auto", poses: int = 20) -> tuple[Solver, StepReport]:
    """Two drives, the second held by a weak prior only, and the first relative pose between both."""
    rng, solver, kind = np.random.default_rng(0), Solver(Options(mode=mode)), "se3" if space else "se2"
    sigmas = (0.05, 0.05, 0.05, 0.02, 0.02, 0.02) if space else (0.05, 0.05, 0.02)

    def pose(x: float, y: float, yaw: float) -> tuple[float, ...]:
        return (x, y, 0, 0, 0, math.sin(yaw / 2), math.cos(yaw / 2)) if space else (x, y, yaw)

    def of(draft: Draft, name: str) -> Callable:
        return getattr(draft, name.format(kind))

    first, second = Draft(), Draft()
    of(first, "{}")("a0", pose(0, 0, 0), fixed=True)
    of(second, "{}")("b0", pose(0, 0, 0))
    of(second, "prior_{}")("b0", pose(0, 0, 0), sigmas=(100.0,) * len(sigmas))
    put(solver, first)
    put(solver, second)
    for i in range(1, poses):
        for robot in "ab":
            edge, z = Draft(), pose(1 + 0.05 * rng.normal(), 0.05 * rng.normal(), 0.1 + 0.02 * rng.normal())
            of(edge, "{}")(f"{robot}{i}")
            of(edge, "between_{}")(f"{robot}{i - 1}", f"{robot}{i}", z, sigmas=sigmas)
            put(solver, edge)
    met = Draft()
    of(met, "between_{}")(f"a{poses - 1}", f"b{poses - 1}", pose(2, 1, math.radians(angle_deg)), sigmas=sigmas)
    return solver, put(solver, met)


@pytest.mark.parametrize("turn_deg", [90, 120, 150, 170])
def test_positions_that_come_late(turn_deg: float) -> None:
    rng, solver, x, told, optimum = np.random.default_rng(3), Solver(), np.zeros(3), 0, 0.0
    turn = math.radians(turn_deg)
    R = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    put(solver, Draft().se2("x0", (0, 0, 0)).prior_se2("x0", (0, 0, 0), sigmas=(10, 10, 10)))
    for i in range(1, 60):
        u, c, s = np.array([1, 0, 0.05 * math.sin(i / 5)]), math.cos(x[2]), math.sin(x[2])
        x = x + np.array([c * u[0] - s * u[1], s * u[0] + c * u[1], u[2]])
        draft = Draft().se2(f"x{i}")
        draft.between_se2(f"x{i - 1}", f"x{i}", u + rng.normal(size=3) * [0.05, 0.05, 0.02], sigmas=(0.05, 0.05, 0.02))
        if i >= 30:
            draft.position_se2(f"x{i}", R @ x[:2] + rng.normal(size=2) * 0.5, sigmas=(0.5, 0.5))
        report = put(solver, draft)
        optimum, told = settled_apart(solver), told + report.converged
        assert not report.converged or report.chi2 + FLOOR <= 1.001 * (optimum + FLOOR)
    assert told > 50
    finish(solver)
    assert solver.chi2() == pytest.approx(optimum, rel=1e-6)


@pytest.mark.parametrize("sigma", [1e-5, 1e-6, 1e-7])
def test_stiff_links_beside_a_weak_prior_are_taken(sigma: float) -> None:
    """Ratios of information up to 10²⁴: none of it is refused, and the map goes to the optimum of the rest."""
    seen = {}
    for of in (sigma, 0.0):
        solver = rig_drive(of)
        finish(solver)
        poses = {key: row for g in solver.estimate() for key, row in zip(g.keys.tolist(), g.values, strict=True)}
        # The prior holds the map as a whole to within 1e5 m: what counts is how it lies seen from its first pose.
        first = poses[symbol("x", 0)]
        c, s = math.cos(first[2]), math.sin(first[2])
        seen[of] = (
            solver.chi2(),
            {key: np.array([[c, s], [-s, c]]) @ (row - first)[:2] for key, row in poses.items() if key in range(*X)},
        )
    assert seen[sigma][0] == pytest.approx(seen[0.0][0], rel=1e-6)
    for key, place in seen[0.0][1].items():
        np.testing.assert_allclose(seen[sigma][1][key], place, atol=1e-2)


@pytest.mark.parametrize("pairs", [1, 3, 7])
def test_links_so_stiff_that_pivots_are_raised_do_not_end_a_step(pairs: int) -> None:
    """Σ error² says nothing of a direction whose pivot was raised: it said converged at 1.04 times the optimum.  Damped
    steps took off 1e-6 of χ² each, further than anybody waits."""
    solver, plain = Solver(), Solver(BATCH)
    for step in WORLDS["manhattan"](1500, 5):
        for each in (solver, plain):
            each.stage(step.batch)
    for n in range(pairs):
        at, first, second = f"x{10 + 200 * n}", f"r{2 * n}", f"r{2 * n + 1}"
        draft = Draft().se2(first).se2(second).between_se2(at, first, (1, 0, 0.5), sigmas=(1, 1, 1))
        solver.stage(draft.between_se2(first, second, (1, 0, 0.5), sigmas=(1e-8, 1e-8, 1e-8)).batch())
    report = solver.step()
    said = [report] + [solver.step() for _ in range(8)]
    # A chain that nothing else holds fits exactly: the optimum is that of the map without it, which has no such link.
    optimum = plain.step(settle=True).chi2
    for report in said:
        assert report.converged
        assert report.chi2 == pytest.approx(optimum, rel=1e-6)
    # What adds nothing does not take back that it has converged; a loop that pulls does.
    last = 1499
    assert put(
        solver, Draft().se2("x2000").between_se2(f"x{last}", "x2000", (1, 0, 0), sigmas=(0.1, 0.1, 0.1))
    ).converged
    pulls = put(solver, Draft().between_se2("x2000", "x0", (0, 0, 0), sigmas=(0.1, 0.1, 0.1)))
    assert not pulls.converged or pulls.chi2 <= 1.001 * settled_apart(solver)


def rig_drive(sigma: float, poses: int = 300) -> Solver:
    """A drive round a square whose loops close; every tenth pose has a second one joined to it by `sigma`, if any."""
    rng, solver, true = np.random.default_rng(1), Solver(), [np.zeros(3)]
    put(solver, Draft().se2("x0", (0, 0, 0)).prior_se2("x0", (0, 0, 0), sigmas=(1e5, 1e5, 1e5)))
    for i in range(1, poses):
        u, (x, y, a) = np.array([1.0, 0.0, math.pi / 2 if i % 25 == 0 else 0.0]), true[-1]
        true.append(np.array([x + math.cos(a), y + math.sin(a), a + u[2]]))
        draft, noise = Draft().se2(f"x{i}"), rng.normal(size=6)
        z = u + noise[:3] * [0.05, 0.05, 0.01]
        draft.between_se2(f"x{i - 1}", f"x{i}", z, sigmas=(0.1, 0.1, 0.02))
        if i >= 100 and i % 10 == 0:
            draft.between_se2(f"x{i - 100}", f"x{i}", noise[3:] * [0.05, 0.05, 0.01], sigmas=(0.1, 0.1, 0.02))
        if sigma and i % 10 == 0:
            draft.se2(f"r{i}").between_se2(f"x{i}", f"r{i}", (0.3, 0, 0.1), sigmas=(sigma, sigma, sigma))
        put(solver, draft)
    return solver


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("world", ["manhattan", "city_trees", "sphere"])
def test_a_map_with_nothing_to_do_finishes(world: str, mode: str) -> None:
    solver = Solver(Options(mode=mode))
    for step in WORLDS[world](250, 31):
        solver.stage(step.batch)
        solver.step()
    steps = finish(solver)
    optimum = settled_apart(solver)
    assert steps <= 3
    assert solver.chi2() == pytest.approx(optimum, rel=1e-6)
    before = [group.values.tobytes() for group in solver.estimate()]
    report = solver.step()
    assert (report.converged, solver.unfinished) == (True, False)
    assert [group.values.tobytes() for group in solver.estimate()] == before
    assert report.chi2 == pytest.approx(optimum, rel=1e-6)


@pytest.mark.parametrize("mode", MODES)
def test_with_losses_too(mode: str) -> None:
    """Weights follow the residuals more slowly than Gauss-Newton's last steps are long."""
    solver = Solver(Options(mode=mode))
    for step in outliers(150, 3):
        solver.stage(step)
        solver.step()
    finish(solver, 5)
    assert solver.chi2() == pytest.approx(settled_apart(solver), rel=1e-6)


def outliers(poses: int, seed: int) -> Iterator[Batch]:
    """A drive round a square; one in ten of its closures is wrong, and all have Huber's loss."""
    rng, true = np.random.default_rng(seed), [np.zeros(3)]
    yield Draft().se2("x0", (0, 0, 0), fixed=True).batch()
    for i in range(1, poses):
        u, (x, y, a) = np.array([1.0, 0.0, math.pi / 2 if i % 10 == 0 else 0.0]), true[-1]
        true.append(np.array([x + math.cos(a), y + math.sin(a), a + u[2]]))
        draft, noise = Draft().se2(f"x{i}"), rng.normal(size=6)
        sigmas = (0.05, 0.05, 0.01)
        draft.between_se2(f"x{i - 1}", f"x{i}", u + noise[:3] * sigmas, sigmas=sigmas)
        if i >= 40 and i % 4 == 0:
            z = noise[3:] * sigmas + (np.array([0.5, -0.7, 0.2]) if i % 40 == 0 else 0.0)
            draft.between_se2(f"x{i - 40}", f"x{i}", z, sigmas=sigmas, loss=("huber", 1.5))
        yield draft.batch()


def test_what_a_step_says_of_a_continued_map() -> None:
    solver, _ = ring(120, poses=200)
    report = solver.step()
    assert (report.new_variables, report.new_factors) == (0, 0)
    assert report.chi2_before == pytest.approx(report.chi2, rel=1e-3)


def put(solver: Solver, draft: Draft) -> StepReport:
    solver.stage(draft.batch())
    return solver.step()


def finish(solver: Solver, most: int = 40) -> int:
    """Steps with nothing new until there is no more to gain."""
    for n in range(most):
        if not solver.unfinished:
            return n
        solver.step()
    raise AssertionError(f"unfinished after {most} steps")


def settled_apart(solver: Solver) -> float:
    """χ² of the batch optimum from the estimate, by another solver."""
    other = Solver(BATCH)
    variables, factors = solver.graph()
    other.stage(Batch(tuple(variables), tuple(factors)))
    return other.step(settle=True).chi2
