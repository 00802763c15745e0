"""One factor of sixteen variables: covariance, gate, gain, why and marginals are those of dense NumPy."""

from dataclasses import asdict

import numpy as np
import pytest
from naive.dense_answers import check_factor
from naive.dense_covariances import DenseCovariance
from naive.dense_factors import TANGENT, boxplus
from naive.dense_least_squares import DenseGraph, distance
from naive.random_graphs import random_information, random_value
from naive.random_others import random_other
from naive.solver_parts import keys_in

from factorbus.proto.kinds import linear_kind
from factorbus.proto.messages import Batch, Change, Factors, Variables
from factorbus.proto.symbols import symbol
from factorbus.solver import FactorGroup, Options, Solver
from factorbus.solver.changing import with_changes
from factorbus.solver.covariance.blocks import CovarianceBlocks
from factorbus.solver.covariance.candidates import evaluate_candidates
from factorbus.solver.covariance.why import why_factor

MODES = ["bayes-tree", "inc-l", "all-batch"]
COUNT = 16
SPACES = {"plane": ("se2", "point2", "vector1", "vector4"), "space": ("se3", "point3", "idp", "vector3", "vector9")}
KEYS = [symbol("v", n) for n in range(COUNT)]


def drive(space: str, rows: int, seed: int, loss: str = "") -> list[Batch]:
    """Priors and linear factors of one variable each, one of two between neighbours, and one factor of all sixteen."""
    rng = np.random.default_rng(seed)
    kinds = [str(kind) for kind in rng.choice(SPACES[space], COUNT)]
    kinds[0] = SPACES[space][0]
    truth = dict(zip(KEYS, [random_value(kind, rng) for kind in kinds], strict=True))

    def linear(some: list[int], rows: int, loss: str = "") -> Factors:
        kind = linear_kind(rows, tuple(kinds[n] for n in some))
        z = random_other(kind.name, [truth[KEYS[n]] for n in some], 0.03, rng)
        group = Factors(kind.name, np.array([[KEYS[n] for n in some]]), z[None], random_information(rows, rng)[None])
        return group._replace(loss=loss, scale=np.array([1.0])) if loss else group

    steps = []
    for n, kind in enumerate(kinds):
        start = boxplus(kind, truth[KEYS[n]], rng.normal(0, 0.03, TANGENT[kind]))
        factors = [linear([n], TANGENT[kind])]
        factors += [linear([n - 1, n], min(TANGENT[kind], 3))] if n else []
        steps.append(Batch((Variables(kind, np.array(KEYS[n : n + 1]), start[None]),), tuple(factors)))
    order = rng.permutation(COUNT).tolist()
    return [*steps, Batch((), (linear(order, rows, loss),)), Batch((), (linear(order[:5], 3),))]


def solved(batches: list[Batch], mode: str) -> tuple[Solver, DenseGraph]:
    solver, twin = Solver(Options(mode=mode)), DenseGraph()
    for batch in batches:
        solver.stage(batch)
        report = solver.step()
        twin.add(batch)
        twin.put(solver.estimate())
        assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9)
    solver.step(settle=True)
    twin.put(solver.estimate())
    return solver, twin


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("loss", ["", "huber"])
@pytest.mark.parametrize(("space", "rows"), [("plane", 6), ("plane", 30), ("space", 64)])
def test_estimate_and_covariances_are_those_of_dense_matrices(space: str, rows: int, loss: str, mode: str) -> None:
    solver, twin = solved(drive(space, rows, 3, loss), mode)
    assert solver.chi2() == pytest.approx(twin.chi2(), rel=1e-9)
    assert twin.gauss_newton(iterations=1) < 1e-7
    known, blocks = DenseCovariance(twin), CovarianceBlocks(solver.covariances.factored())
    index = {key: n for n, key in enumerate(keys_in(solver))}
    together = blocks.joint(np.array([index[key] for key in KEYS]))
    np.testing.assert_allclose(together, known.joint(KEYS), rtol=0, atol=1e-8 * np.abs(together).max())


@pytest.mark.parametrize(("space", "rows"), [("plane", 6), ("space", 64)])
def test_gate_gain_and_why_are_those_of_dense_matrices(space: str, rows: int) -> None:
    batches = drive(space, rows, 4, "huber")
    solver, twin = solved(batches, "bayes-tree")
    known, blocks = DenseCovariance(twin), CovarianceBlocks(solver.covariances.factored())
    big = next(n for n, (_, keys, *_) in enumerate(twin.factors) if len(keys) == COUNT)
    check_factor(why_factor(blocks, big).as_dict(), known, atol=1e-8, rel=1e-6)
    (sent,) = batches[-2].factors
    off = sent.measured.copy()
    off[0, -rows:] += np.random.default_rng(1).normal(0, 0.05, rows)  # b
    found = evaluate_candidates(blocks, [FactorGroup(sent.kind, sent.keys, off, sent.information)])
    r, spread, noise = known.innovation(sent.kind, sent.keys[0].tolist(), off[0], sent.information[0])
    assert found.distance[0] == pytest.approx(r @ np.linalg.solve(spread + noise, r), rel=1e-7)
    gain = 0.5 * np.linalg.slogdet(np.eye(rows) + np.linalg.solve(noise, spread))[1]
    assert found.gain[0] == pytest.approx(gain, rel=1e-8)
    assert found.dims.tolist() == [rows]
    assert asdict(found)["predicted"].shape == (1, rows, rows)
    np.testing.assert_allclose(found.predicted[0], spread, rtol=0, atol=1e-8 * np.abs(spread).max())


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(("space", "rows"), [("plane", 30), ("space", 64)])
def test_what_is_left_when_some_are_marginalized_is_what_it_was(space: str, rows: int, mode: str) -> None:
    solver, twin = solved(drive(space, rows, 5), mode)
    known, gone = DenseCovariance(twin), KEYS[3:9]
    after, *_ = with_changes(solver, [Change("marginalize", keys=np.array(gone))], settle=True)
    there = {key: (g.kind, row) for g in after.estimate() for key, row in zip(g.keys.tolist(), g.values, strict=True)}
    left = [key for key in KEYS if key not in gone]
    assert sorted(there) == left
    for key, (kind, row) in there.items():
        assert distance(kind, row, twin.values[key]) < 1e-8
    index = {key: n for n, key in enumerate(keys_in(after))}
    blocks = CovarianceBlocks(after.covariances.factored())
    together = blocks.joint(np.array([index[key] for key in left]))
    np.testing.assert_allclose(together, known.joint(left), rtol=0, atol=1e-8 * np.abs(together).max())


@pytest.mark.parametrize("joined", [3, 7])
def test_an_omega_update_takes_the_largest_factors_that_it_is_chosen_for(joined: int) -> None:
    """More rows than variables have scalars are never sent, and with more pairs of variables it is not chosen."""
    rng, keys = np.random.default_rng(2), KEYS[:12]
    truth = {key: random_value("se3", rng) for key in keys}
    often = {"small_loop_threshold": 10**6, "big_loop_threshold": 10**6, "loop_threshold_share": 1e6}
    solver, twin = Solver(Options.of(mode="inc-l", **often)), DenseGraph()
    steps = []
    for n, key in enumerate(keys):
        some = [key] if n == 0 else [keys[n - 1], key]
        kind = linear_kind(6, ("se3",) * len(some))
        z = random_other(kind.name, [truth[k] for k in some], 0.01, rng)
        factor = Factors(kind.name, np.array([some]), z[None], random_information(6, rng)[None])
        steps.append(Batch((Variables("se3", np.array([key]), truth[key][None]),), (factor,)))
    kind, some = linear_kind(6 * joined + 1, ("se3",) * joined), rng.permutation(keys)[:joined].tolist()
    z = random_other(kind.name, [truth[key] for key in some], 0.01, rng)
    loop = Factors(kind.name, np.array([some]), z[None], random_information(kind.dim, rng)[None])
    for batch in [*steps, Batch((), (loop,))]:
        solver.stage(batch)
        report = solver.step()
        twin.add(batch)
        twin.put(solver.estimate())
    assert report.strategy == "omega"
    assert report.chi2 == pytest.approx(twin.chi2(), rel=1e-9)
    solver.step(settle=True)
    twin.put(solver.estimate())
    assert twin.gauss_newton(iterations=1) < 1e-7
