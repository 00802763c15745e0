"""The map of the golden messages: every number of their answers again, with dense matrices, from its inserts."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from naive.dense_answers import check_blocks, check_candidates, check_cross, check_factor, check_pairs
from naive.dense_covariances import DenseCovariance, best_association
from naive.dense_factors import jacobians, residual
from naive.dense_least_squares import CONNECTS, DenseGraph, distance, rho
from scipy.stats import chi2 as chi2_distribution

from factorbus.proto import asking_codec as asked
from factorbus.proto import codec
from factorbus.proto import repair_codec as repairs
from factorbus.proto.messages import Batch, Variables
from factorbus.proto.symbols import symbol

VECTORS = Path(__file__).parents[2] / "proto" / "vectors"
X = [symbol("x", i) for i in range(3)]
FALSE = 3
# They are rounded to nine significant digits, and our Jacobians are differences.
REL, ATOL = 2e-7, 2e-9


def read(name: str) -> bytes:
    return (VECTORS / f"{name}.msgpack").read_bytes()


def inserted(*names: str) -> DenseGraph:
    """The map that these inserts lead to; what has no value is composed of the odometry that leads to it."""
    graph = DenseGraph()
    for name in names:
        batch = codec.decode_insert(read(name)).batch
        graph.add(batch)
        graph.put(group for group in batch.variables if group.values is not None)
        for group in batch.variables:
            if group.values is None:
                (edge,) = batch.factors
                start, z = graph.values[int(edge.keys[0, 0])], edge.measured[0]
                graph.values[int(group.keys[0])] = composed(start, z)
    return graph


def composed(a: np.ndarray, z: np.ndarray) -> np.ndarray:
    c, s = np.cos(a[2]), np.sin(a[2])
    return np.array([a[0] + c * z[0] - s * z[1], a[1] + s * z[0] + c * z[1], a[2] + z[2]])


@pytest.fixture(scope="module")
def dense() -> DenseGraph:
    graph = inserted("insert", "insert_without_values", "insert_loop")
    assert graph.gauss_newton(200) < 1e-10
    return graph


@pytest.fixture(scope="module")
def known(dense: DenseGraph) -> DenseCovariance:
    return DenseCovariance(dense)


def check_values(groups: tuple[Variables, ...], graph: DenseGraph, within: float = 2e-8) -> set[int]:
    """Which keys are told."""
    for group in groups:
        for key, row in zip(group.keys.tolist(), group.values, strict=True):
            assert distance(group.kind, row, graph.values[key]) < within
            assert group.fixed == (key in graph.fixed)
    return {key for group in groups for key in group.keys.tolist()}


def stated(batch: Batch) -> DenseGraph:
    """The map that a graph message says, at its values."""
    graph = DenseGraph()
    graph.add(batch)
    graph.put(batch.variables)
    return graph


def test_the_first_insert_agrees_and_is_answered_so() -> None:
    graph, accepted = inserted("insert"), codec.decode_accepted(read("accepted"))
    assert accepted.report["chi2"] == 0.0
    assert graph.chi2() < 1e-24
    assert (accepted.sequence, accepted.first_factor, accepted.revision) == (1, 0, 1)


def test_estimate_graph_delta_and_chi2_are_of_the_optimum(dense: DenseGraph) -> None:
    every = set(dense.values)
    assert check_values(codec.decode_estimate(read("estimate")).variables, dense) == every
    graph = codec.decode_graph(read("graph"))
    assert check_values(graph.batch.variables, dense) == every
    delta = codec.decode_delta(read("delta"))
    assert check_values(delta.variables, dense) == every - dense.fixed
    assert (delta.previous, delta.revision) == (2, 3)
    for told in (
        delta.report["chi2"], codec.decode_chi2(read("chi2")).chi2, codec.decode_chi2(read("chi2_batch")).chi2,
        codec.decode_chi2(read("chi2_batch")).batch,
    ):  # fmt: skip
        assert told == pytest.approx(dense.chi2(), rel=1e-8)
    again = stated(graph.batch)
    assert sorted(map(str, again.factors)) == sorted(map(str, dense.factors))
    assert sorted(again.losses) == sorted(dense.losses)


def test_a_job_is_answered_with_its_optimum(dense: DenseGraph) -> None:
    job, done = codec.decode_job(read("job")), codec.decode_job_done(read("job_done"))
    assert (job.job, job.kind) == (done.job, done.kind)
    assert job.payload == read("graph")
    optimum = codec.decode_optimum(done.payload)
    check_values(optimum.variables, dense)
    assert optimum.chi2 == pytest.approx(dense.chi2(), rel=1e-8)


def test_a_search_that_ended_too_early_says_so(dense: DenseGraph) -> None:
    job, done = codec.decode_job(read("job")), codec.decode_job_done(read("job_done_not_converged"))
    assert done.job == job.job
    optimum, told = codec.decode_optimum(done.payload), codec.decode_chi2(read("chi2_not_converged"))
    there = stated(codec.decode_graph(job.payload).batch)
    there.put(optimum.variables)
    assert (told.batch, told.start) == (optimum.chi2, optimum.start)
    assert optimum.chi2 == pytest.approx(there.chi2(), rel=1e-7)
    assert (optimum.converged, told.batch_converged) == (False, False)
    assert there.gauss_newton(1) > 1e-3, "a step would lead on"
    assert told.chi2 == pytest.approx(dense.chi2(), rel=1e-8)
    assert told.batch > 1.0001 * told.chi2


def test_without_the_false_factor_it_is_another_optimum() -> None:
    graph = codec.decode_graph(read("graph_ids"))
    assert sorted(each for group in graph.batch.factors for each in group.ids.tolist()) == [0, 1, 2, 4, 5, 6]
    found = inserted("insert", "insert_without_values", "insert_loop")
    found.factors.pop(FALSE), found.losses.pop(FALSE)
    assert found.gauss_newton(200) < 1e-10
    check_values(graph.batch.variables, found)


def test_covariances_are_those_of_the_map(dense: DenseGraph, known: DenseCovariance) -> None:
    tell = {"rtol": REL, "atol": ATOL}
    groups = asked.decode_covariances(read("covariances")).groups
    check_blocks(groups, known, **tell)
    assert {key for group in groups for key in group.keys.tolist()} == set(dense.values)
    joint, question = (asked.decode_covariances(read("covariances_joint")), ask_covariance("joint"))
    assert joint.keys.tolist() == question.keys.tolist()
    np.testing.assert_allclose(joint.covariance, known.joint(joint.keys.tolist()), **tell)
    cross, question = asked.decode_covariances(read("covariances_cross")), ask_covariance("cross")
    assert (cross.keys.tolist(), cross.others.tolist()) == (question.keys.tolist(), question.others.tolist())
    check_cross(cross, known, **tell)


def test_relative_covariances_are_propagated(dense: DenseGraph, known: DenseCovariance) -> None:
    """x₁⁻¹ ∘ x₂ and R₁ᵀ (l − t₁), whose Jacobians are those of `between` and `landmark` factors that measure them."""
    pairs = []
    for group in asked.decode_covariances(read("covariances_relative")).groups:
        for keys, value, block in zip(group.keys.tolist(), group.values, group.covariance, strict=True):
            kind = {"se2": "between_se2", "point2": "landmark_se2"}[group.kind]
            ends = [dense.values[key] for key in keys]
            np.testing.assert_allclose(residual(kind, ends, value), 0.0, atol=2e-8)
            H = np.hstack(jacobians(kind, CONNECTS[kind], ends, value))
            np.testing.assert_allclose(block, H @ known.joint(keys) @ H.T, rtol=REL, atol=ATOL)
            pairs.append(keys)
    assert sorted(pairs) == sorted(ask_covariance("relative").keys.tolist())


def ask_covariance(blocks: str) -> Any:
    return asked.decode_ask_covariance(read(f"ask_covariance_{blocks}"))


def test_gates_and_gains_are_those_of_the_map(known: DenseCovariance) -> None:
    gate, gain = asked.decode_ask_gate(read("ask_gate")), asked.decode_ask_gain(read("ask_gain"))
    assert [group.measured.tolist() for group in gate.factors] == [group.measured.tolist() for group in gain.factors]
    gated, gained = asked.decode_gated(read("gated")), asked.decode_gained(read("gained"))
    check_candidates(gate, gated, gained, known, REL)


def test_pairs_are_the_largest_set_that_is_compatible(known: DenseCovariance) -> None:
    seen, found = asked.decode_ask_associate(read("ask_associate")), asked.decode_associated(read("associated"))
    check_pairs(seen, found, known, 1e-6)
    pairs = [(s, int(landmark)) for s in range(len(seen.measured)) for landmark in seen.landmarks]
    parts = [known.innovation(seen.kind, [seen.pose, key], seen.measured[s], seen.information[s]) for s, key in pairs]
    gates = [chi2_distribution.ppf(seen.probability, 2 * count) if count else 0.0 for count in range(3)]
    near = [n for n, (r, spread, noise) in enumerate(parts) if r @ np.linalg.solve(spread + noise, r) <= gates[1]]
    assert [(int(s), int(key)) for s, key in zip(found.observations, found.candidates, strict=True)] == [
        pairs[n] for n in near
    ]
    (only,) = near  # of several their innovations would be correlated
    r, spread, noise = parts[only]
    d2, best = best_association(spread + noise, r, [pairs[only]], 2, np.array(gates))
    assert best == (0,)
    assert found.distance == pytest.approx(d2, rel=1e-6)
    assert (found.dims, found.threshold) == (2, pytest.approx(gates[1], rel=1e-8))
    assert found.landmarks[found.matched].tolist() == [pairs[only][1]]
    assert found.matched.tolist() == [n == pairs[only][0] for n in range(len(seen.measured))]


def test_why_is_what_the_equations_say(known: DenseCovariance) -> None:
    told = asked.decode_why(read("why")).factor
    assert told["factor"] == asked.decode_ask_why(read("ask_why_factor")).factor == FALSE
    check_factor(told, known, 2e-8, 2e-6)
    variable = asked.decode_why(read("why_variable")).variable
    assert variable["key"] == asked.decode_ask_why(read("ask_why")).key == X[1]
    block = known.joint([X[1]])
    np.testing.assert_allclose(variable["covariance"], block, rtol=REL, atol=ATOL)
    np.testing.assert_allclose(variable["sigmas"], np.sqrt(np.diag(block)), rtol=REL)
    on_it = [n for n, (_, keys, *_) in enumerate(known.graph.factors) if X[1] in keys]
    assert [each["factor"] for each in variable["factors"]] == on_it
    for each in variable["factors"]:
        check_factor(each, known, 2e-8, 2e-6)


def test_the_pivots_of_a_variable_are_those_of_its_elimination(known: DenseCovariance) -> None:
    """Whatever order: 1/σ of each scalar given those behind it is between its own alone and that given all others."""
    variable = asked.decode_why(read("why_variable")).variable
    information, _ = known.graph.system()
    start = known.graph.starts()[X[1]]
    most = np.sqrt(np.diag(information)[start : start + 3])
    assert 1.0 / max(variable["sigmas"]) - 1e-6 <= variable["pivot"] <= most.min() + 1e-6
    assert 0.0 < variable["conditioning"] <= 1.0


def test_what_is_repaired_is_false(dense: DenseGraph) -> None:
    ask, told = repairs.decode_ask_repair(read("ask_repair")), repairs.decode_repaired(read("repaired"))
    assert told.suspects == len(ask.factors)
    assert told.factors.tolist() == [FALSE]
    bound = chi2_distribution.ppf(ask.probability, 3)

    def cost(graph: DenseGraph) -> tuple[float, float]:
        """Σ min(s, c²) over the suspects and Σ ρ of the others; and s of the false one."""
        total, false = 0.0, 0.0
        for n, ((kind, keys, z, W), (loss, k)) in enumerate(zip(graph.factors, graph.losses, strict=True)):
            r = residual(kind, [graph.values[key] for key in keys], z)
            s = float(r @ W @ r)
            total += min(s, bound) if n in ask.factors else rho(loss, k, s)
            false = s if n == FALSE else false
        return total, false

    assert told.before == pytest.approx(cost(dense)[0], rel=1e-7)
    repaired = inserted("insert", "insert_without_values", "insert_loop")
    repaired.put(told.variables)
    after, s = cost(repaired)
    assert told.after == pytest.approx(after, rel=1e-7)
    assert told.distance.tolist() == pytest.approx([s], rel=1e-7)
    assert told.chi2_left == pytest.approx(after - bound, rel=1e-7)
    best = inserted("insert", "insert_without_values", "insert_loop")
    best.factors.pop(FALSE), best.losses.pop(FALSE)
    best.gauss_newton(200)
    check_values(told.variables, best, 1e-5)  # graduated: to what costs nothing that could be told


def test_a_worse_minimum_is_one_and_the_better_one_is_adopted() -> None:
    graph = codec.decode_graph(read("graph_worse")).batch
    told, done = codec.decode_chi2(read("chi2_better")), codec.decode_job_done(read("job_done_start"))
    here = stated(graph)
    information, eta = here.system()
    assert np.abs(np.linalg.solve(information, eta)).max() < 1e-7, "a Gauss-Newton step leads nowhere"
    assert told.chi2 == pytest.approx(here.chi2(), rel=1e-8)
    optimum = codec.decode_optimum(done.payload)
    there = stated(graph)
    there.put(optimum.variables)
    assert there.gauss_newton(1) < 1e-7
    assert told.batch == optimum.chi2 == pytest.approx(there.chi2(), rel=1e-8)
    assert told.start == optimum.start
    assert told.notice is not None
    assert told.notice.detail == {"chi2": told.chi2, "batch": told.batch, "start": told.start}
    (place,) = codec.decode_insert(read("insert_adopt")).changes
    assert place.carry
    (free,) = (group for group in told.variables if not group.fixed)
    assert (place.kind, place.keys.tolist(), place.values.tolist()) == (
        free.kind, free.keys.tolist(), free.values.tolist()
    )  # fmt: skip


def test_what_has_time_stamps_is_solved_as_what_has_none() -> None:
    graph = inserted("insert_stamps")
    assert graph.gauss_newton(200) < 1e-10
    sent = {group.kind + str(group.fixed): group.stamps.tolist() for group in insert_stamps()}
    estimate, delta = codec.decode_estimate(read("estimate_stamps")), codec.decode_delta(read("delta_stamps"))
    told = codec.decode_graph(read("graph_stamps")).batch.variables
    for groups in (estimate.variables, delta.variables, told):
        check_values(groups, graph)
        assert all(group.stamps.tolist() == sent[group.kind + str(group.fixed)] for group in groups)
    assert delta.report["chi2"] == pytest.approx(graph.chi2(), abs=1e-12)


def insert_stamps() -> tuple[Variables, ...]:
    return codec.decode_insert(read("insert_stamps")).batch.variables
