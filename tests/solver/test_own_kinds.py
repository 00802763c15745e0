"""Kinds that clients write themselves: the solver does with them what it does with its own."""

from dataclasses import asdict

import numpy as np
import pytest
from naive.dense_least_squares import distance
from naive.own_formulas import OWN, both
from naive.solver_parts import graph_in, keys_in

from factorbus.client.expressions import SE2, SE3, Point2, Point3, Vector, factor, norm, sqrt
from factorbus.proto.expressions.formula import read_formula
from factorbus.proto.kinds import FACTOR_KINDS
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import FactorGroup, Options, Solver, errors
from factorbus.solver.changing import try_change, with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.covariance.why import why_factor
from factorbus.solver.graph.own_kinds import MOST_OWN


@factor
def own_range(a: SE2, l: Point2, z: Vector[1]):
    return norm(a.position - l) - z


MODES = ["bayes-tree", "inc-l", "all-batch"]


def values_of(solver: Solver) -> dict[int, tuple[str, np.ndarray]]:
    return {
        key: (group.kind, row)
        for group in solver.estimate()
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }


def solve_both(seed: int, mode: str = "bayes-tree", loss: str = "", steps: int = 6) -> tuple[Solver, Solver]:
    """Of the solver's kinds, and of the same written anew; settled."""
    usual, own = Solver(Options(mode=mode)), Solver(Options(mode=mode))
    for batches in both(seed, steps, loss):
        for solver, batch in zip((usual, own), batches, strict=True):
            solver.stage(batch)
            solver.step()
    usual.step(settle=True)
    own.step(settle=True)
    return usual, own


def same(usual: Solver, own: Solver, most: float = 1e-7) -> None:
    there = values_of(own)
    assert own.chi2() == pytest.approx(usual.chi2(), rel=1e-7)
    assert max(distance(kind, row, there[key][1]) for key, (kind, row) in values_of(usual).items()) < most


def close(found: np.ndarray, wanted: np.ndarray, tell: float) -> None:
    np.testing.assert_allclose(found, wanted, rtol=0, atol=tell * np.abs(wanted).max())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loss", ["", "huber", "dcs"])
def test_a_map_of_own_kinds_settles_where_one_of_the_solvers_kinds_does(loss: str, mode: str) -> None:
    usual, own = solve_both(1, mode, loss)
    same(usual, own)
    kinds = {group.kind for group in own.graph()[1]}
    assert len([kind for kind in kinds if FACTOR_KINDS[kind].own]) >= 10


def test_chi2_is_the_same_after_every_step() -> None:
    usual, own = Solver(Options(mode="all-batch")), Solver(Options(mode="all-batch"))
    for batches in both(2, 6):
        reports = []
        for solver, batch in zip((usual, own), batches, strict=True):
            solver.stage(batch)
            reports.append(solver.step())
        assert reports[1].chi2 == pytest.approx(reports[0].chi2, rel=1e-9)
        assert reports[1].chi2 == pytest.approx(own.chi2(), rel=1e-9)


def test_covariance_gate_gain_and_why_are_those_of_the_solvers_kinds() -> None:
    usual, own = solve_both(3)
    here, there = (CovarianceBlocks(solver.covariances.factored()) for solver in (usual, own))
    close(there.diagonal(), here.diagonal(), 1e-6)
    some = np.random.default_rng(3).permutation(len(keys_in(usual)))[:6]
    close(there.joint(some), here.joint(some), 1e-6)
    *_, (last, _) = both(3)
    groups = [FactorGroup(g.kind, g.keys, g.measured, 0.1 * g.information) for g in last.factors]
    of_own = [g._replace(kind=OWN[g.kind].name) if g.kind in OWN else g for g in groups]
    wanted, found = evaluate_candidates(here, groups), evaluate_candidates(there, of_own)
    np.testing.assert_allclose(found.distance, wanted.distance, rtol=1e-4)
    np.testing.assert_allclose(found.gain, wanted.gain, rtol=1e-6)
    for n in range(usual.factor_count):
        first, second = (asdict(why_factor(blocks, n)) for blocks in (here, there))
        assert second["kind"] == OWN.get(first["kind"], FACTOR_KINDS[first["kind"]]).name
        for name in ("chi2", "leverage"):
            assert second[name] == pytest.approx(first[name], rel=1e-4, abs=1e-7)


@pytest.mark.parametrize("mode", MODES)
def test_own_kinds_can_be_weighed_removed_and_marginalized(mode: str) -> None:
    usual, own = solve_both(4, mode)
    some = np.array([3, 8, 11, 20])
    changes = (
        Change("loss", factors=some, loss="cauchy", scale=np.full(4, 2.0)),
        Change("weigh", factors=some, weight=np.full(4, 0.5)),
        Change("remove_factors", factors=np.array([25])),
    )
    after = [with_changes(solver, changes, settle=True)[0] for solver in (usual, own)]
    same(after[0], after[1])
    gone = (Change("marginalize", keys=np.array([symbol("x", 0), symbol("y", 0)])),)
    after = [with_changes(solver, gone, settle=True)[0] for solver in after]
    same(after[0], after[1])
    tried = [try_change(solver, changes[:1]) for solver in (usual, own)]
    assert [type(each) for each in tried] == [type(tried[0])] * 2
    kept = {group.kind for group in after[1].graph()[1]}
    assert any(FACTOR_KINDS[kind].own for kind in kept)


def test_a_state_goes_on_to_the_bit() -> None:
    first, second = Solver(Options()), Solver(Options())
    batches = [own for _, own in both(5, 6)]
    for batch in batches[:4]:
        first.stage(batch)
        first.step()
    second.load(first.dump())
    for batch in batches[4:]:
        for solver in (first, second):
            solver.stage(batch)
            solver.step()
    assert first.chi2() == second.chi2()
    here, there = values_of(first), values_of(second)
    assert all((there[key][1] == row).all() for key, (_, row) in here.items())
    assert [group.kind for group in first.graph()[1]] == [group.kind for group in second.graph()[1]]


@factor
def bias_of_range(a: SE3, l: Point3, bias: Vector[1], z: Vector[1]):
    return norm(a.inverse().act(l)) + bias - z


def with_range(kind: str, bias: float = 0.1, z: float = 2.0) -> Batch:
    x, l, b = symbol("x", 0), symbol("l", 0), symbol("b", 0)
    pose, upper = np.array([[0, 0, 0, 0, 0, 0, 1.0]]), np.eye(6)[np.triu_indices(6)][None]
    variables = (
        Variables("se3", np.array([x]), pose),
        Variables("point3", np.array([l]), np.array([[2.0, 0, 0]])),
        Variables("vector1", np.array([b]), np.array([[bias]])),
    )
    factors = (
        Factors("prior_se3", np.array([[x]]), pose, upper),
        Factors("prior_point3", np.array([[l]]), np.array([[2.0, 0, 0]]), np.eye(3)[np.triu_indices(3)][None]),
        Factors(kind, np.array([[x, l, b]]), np.array([[z]]), np.array([[4.0]])),
    )
    return Batch(variables, factors)


def test_a_bias_is_found() -> None:
    solver = Solver(Options())
    solver.stage(with_range(bias_of_range.name, z=2.3))
    solver.step(settle=True)
    assert values_of(solver)[symbol("b", 0)][1] == pytest.approx([0.3], abs=1e-9)
    assert solver.chi2() == pytest.approx(0.0, abs=1e-12)


def test_the_name_of_another_kind_is_refused_while_that_has_factors() -> None:
    solver = Solver(Options())
    solver.stage(with_range(bias_of_range.name))
    solver.step()
    other = "bias_of_range(a:se3,l:point3,bias:vector1,z:1)=subtract(norm(act(inverse(a),l)),add(bias,z))"
    keys = np.array([[symbol("x", 0), symbol("l", 0), symbol("b", 0)]])
    again = Batch((), (Factors(other, keys, np.array([[2.0]]), np.array([[1.0]])),))
    with pytest.raises(errors.KindTaken, match="bias_of_range is bias_of_range"):
        solver.stage(again)
    assert solver.factor_count == 3
    after = with_changes(solver, (Change("remove_factors", factors=np.array([2])),
                                  Change("remove_variables", keys=keys[0, 2:])))[0]  # fmt: skip
    after.stage(Batch((Variables("vector1", keys[0, 2:], np.zeros((1, 1))),), again.factors))
    after.step()
    assert graph_in(after).own == (FACTOR_KINDS[other].name,)


def test_a_map_has_room_for_own_kinds_again_whose_factors_are_gone() -> None:
    solver = Solver(Options())
    solver.stage(with_range(bias_of_range.name))
    solver.step()
    keys = np.array([[symbol("x", 0), symbol("l", 0), symbol("b", 0)]])

    def another(n: int) -> Batch:
        name = bias_of_range.name.replace("bias_of_range", f"kind{n}")
        return Batch((), (Factors(name, keys, np.array([[2.0]]), np.array([[1.0]])),))

    for n in range(MOST_OWN - 1):
        solver.stage(another(n))
    with pytest.raises(errors.TooLarge, match=rf"{MOST_OWN + 1} own kinds, the limit is {MOST_OWN}"):
        solver.stage(another(MOST_OWN))
    solver.step()
    gone = Change("remove_factors", factors=np.arange(4, solver.factor_count))
    after = with_changes(solver, (gone,))[0]
    after.stage(another(MOST_OWN))
    after.step()
    assert len(graph_in(after).own) == 3


def test_a_residual_that_is_no_number_at_the_first_values_is_refused() -> None:
    solver = Solver(Options())
    bad = "bad(a:se3,l:point3,b:vector1,z:1)=divide(add(norm(act(inverse(a),l)),z),b)"
    with pytest.raises(errors.NotFinite, match=r"the residual of bad \(x0, l0, b0\)"):
        solver.stage(with_range(bad, bias=0.0))
    assert (solver.factor_count, graph_in(solver).own) == (0, ())
    solver.stage(with_range(bad, bias=0.5))
    solver.step()


def test_a_name_is_told_in_messages_and_not_its_formula() -> None:
    solver = Solver(Options())
    with pytest.raises(errors.NotFinite, match=r"measurement of bias_of_range \(x0, l0, b0\)"):
        solver.stage(with_range(bias_of_range.name, z=np.nan))
    with pytest.raises(errors.KindMismatch, match=r"bias_of_plane \(x0, l0, b0\)"):
        solver.stage(
            with_range("bias_of_plane(a:se2,l:point2,bias:vector1,z:1)=subtract(norm(act(inverse(a),l)),bias)")
        )
    assert graph_in(solver).own == ()


@factor
def root(a: SE2, z: Vector[1]):
    return sqrt(a.position[0]) - z


def test_where_the_residual_stops_being_a_number_the_factor_counts_for_nothing() -> None:
    solver, x = Solver(Options()), symbol("x", 0)
    pose, upper = np.array([[1.0, 0, 0]]), np.eye(3)[np.triu_indices(3)][None]
    solver.stage(Batch((Variables("se2", np.array([x]), pose),), (Factors("prior_se2", np.array([[x]]), pose, upper),)))
    solver.step()
    far = Factors("prior_se2", np.array([[x]]), np.array([[-2.0, 0, 0]]), 100 * upper)
    odd = "over(a:se2,z:1)=divide(z,sqrt(part(position(a),0,1)))"
    solver.stage(Batch((), (Factors(odd, np.array([[x]]), np.array([[1e-3]]), np.array([[1.0]])), far)))
    report = solver.step(settle=True)
    assert np.isfinite(report.chi2)
    assert np.isfinite(values_of(solver)[x][1]).all()


def large(n: int, numbers: int = 1000) -> Batch:
    """A factor of a kind whose nodes have results of that many numbers."""
    steps = "".join(f"_{k}=multiply(_{k - 1},z);" for k in range(2, numbers // 50))
    name = f"large{n}(a:vector1,z:50)=_1=multiply(z,a);{steps}add(_{numbers // 50 - 1},_1)"
    keys, upper = np.array([[symbol("b", 0)]]), np.eye(50)[np.triu_indices(50)][None]
    return Batch((), (Factors(name, keys, np.full((1, 50), 0.5), upper),))


def joined(*batches: Batch) -> Batch:
    return Batch((), tuple(group for batch in batches for group in batch.factors))


def test_what_is_new_in_one_insert_or_question_and_what_a_map_has_is_bounded() -> None:
    solver = Solver()
    solver.stage(with_range(bias_of_range.name))
    solver.step()
    assert read_formula(large(0).factors[0].kind).result_size == 1000
    two, three = joined(large(0), large(1)), joined(large(0), large(1), large(2))
    solver.check_new_kinds(two)
    blocks = CovarianceBlocks(solver.covariances.factored())
    why = r"has 3000 .* that are new, the limit is 2048; send new kinds in several"
    with pytest.raises(errors.TooLarge, match=why):
        solver.check_new_kinds(three)
    with pytest.raises(errors.TooLarge, match=why):
        evaluate_candidates(blocks, three.factors)
    solver.stage(two)
    solver.check_new_kinds(three)
    for n in range(2, 8):
        solver.stage(large(n))
    with pytest.raises(errors.TooLarge, match="8192; remove the factors of a kind, or write as z"):
        solver.stage(large(8))


def test_a_change_makes_room_for_the_kinds_of_its_insert() -> None:
    """As it removes the last factor of a name, or one of as many kinds as there may be."""
    solver = Solver()
    solver.stage(with_range(bias_of_range.name))
    solver.step()
    keys = np.array([[symbol("x", 0), symbol("l", 0), symbol("b", 0)]])

    def named(name: str, factor: float = 1.0) -> Batch:
        formula = f"{name}(a:se3,l:point3,b:vector1,z:1)=subtract(multiply(norm(act(a,l)),{factor}),add(b,z))"
        return Batch((), (Factors(formula, keys, np.array([[2.0]]), np.array([[1.0]])),))

    for n in range(MOST_OWN - 1):
        solver.stage(named(f"k{n}"))
    solver.step()
    gone = (Change("remove_factors", factors=np.array([solver.factor_count - 1])),)
    with pytest.raises(errors.TooLarge, match="257 own kinds, the limit is 256; remove the factors of a kind"):
        try_change(solver, (Change("weigh", factors=np.array([0]), weight=np.ones(1)),), named("more"))
    for batch in (named("more"), named(f"k{MOST_OWN - 2}", 2.0)):
        came = try_change(solver, gone, batch)
        after = solver if came else with_changes(solver, gone, batch)[0]
        assert FACTOR_KINDS[batch.factors[0].kind].name in graph_in(after).own
        assert after.factor_count == solver.factor_count
        assert len(graph_in(after).own) == MOST_OWN


@pytest.mark.parametrize("seed", range(20))
def test_one_that_its_loss_has_set_aside_leaves_the_error_of_others_as_it_is(seed: int) -> None:
    """With a weight of 0 its linearization error was 0 / 0, and a step had converged whatever was left."""
    reports = []
    for kind in ("range_se2", own_range.name):
        rng, solver = np.random.default_rng(seed), Solver(Options())
        x, point, each = np.arange(3), np.array([10]), np.repeat(np.array([[1, 0, 0, 1, 0, 1.0]]), 3, 0)
        variables = (
            Variables("se2", x, rng.normal(0, 2, (3, 3))),
            Variables("point2", point, rng.normal(0, 5, (1, 2))),
        )
        weak, seen = np.array([[0.01, 0, 0.01]]), np.stack((x, np.full(3, 10)), 1)
        factors = (
            Factors("prior_se2", x[:, None], rng.normal(0, 3, (3, 3)), each),
            Factors("prior_point2", point[None], rng.normal(0, 5, (1, 2)), weak),
            Factors("bearing_se2", seen, rng.uniform(-3, 3, (3, 1)), np.full((3, 1), 100.0)),
            Factors("range_se2", seen[1:], rng.uniform(1, 5, (2, 1)), np.full((2, 1), 100.0)),
            Factors(kind, seen[:1], np.array([[60.0]]), np.eye(1), loss="tukey", scale=np.ones(1)),
        )
        solver.stage(Batch(variables, factors))
        reports.append(solver.step())
    built_in, own = reports
    assert own.converged == built_in.converged
    assert own.chi2 == pytest.approx(built_in.chi2, rel=1e-6)
