"""The worked example of the contract: its bytes, and every number of its answers computed again with dense matrices."""

import json
import runpy
from pathlib import Path

import msgpack
import numpy as np
import pytest
from naive.dense_answers import check_blocks, check_candidates, check_cross, check_factor, check_pairs
from naive.dense_covariances import DenseCovariance
from naive.dense_factors import residual
from naive.dense_least_squares import DenseGraph, rho

from factorbus.proto import asking_codec as asked
from factorbus.proto import codec
from factorbus.proto.kinds import LOSSES
from factorbus.proto.messages import Accepted, Delta, Estimate, MapGraph

ROOT = Path(__file__).parents[2] / "proto" / "vectors"
WORKED = ROOT / "worked"
NAMES = sorted(path.stem for path in WORKED.glob("*.msgpack"))
DESCRIBED = runpy.run_path(str(ROOT / "make.py"))["described"]


def read(name: str) -> bytes:
    return (WORKED / f"{name}.msgpack").read_bytes()


@pytest.fixture(scope="module")
def dense() -> DenseGraph:
    """The map of the example, at its optimum as we find it."""
    graph = DenseGraph()
    for name in ("insert", "insert_more"):
        batch = codec.decode_insert(read(name)).batch
        graph.add(batch)
        graph.put(batch.variables)
    assert graph.gauss_newton(100) < 1e-10
    return graph


@pytest.fixture(scope="module")
def known(dense: DenseGraph) -> DenseCovariance:
    return DenseCovariance(dense)


@pytest.mark.parametrize("name", NAMES)
def test_descriptions_are_of_the_bytes_and_these_in_the_shortest_form(name: str) -> None:
    data = read(name)
    assert DESCRIBED(data) == (WORKED / f"{name}.json").read_text()
    assert msgpack.packb(msgpack.unpackb(data)) == data
    assert json.loads((WORKED / f"{name}.json").read_text())


def test_the_estimate_is_the_optimum(dense: DenseGraph) -> None:
    for told in (codec.decode_estimate(read("estimate")), codec.decode_graph(read("graph")).batch):
        assert isinstance(told, Estimate) or told.factors
        for group in told.variables:
            for key, row in zip(group.keys.tolist(), group.values, strict=True):
                np.testing.assert_allclose(row, dense.values[key], atol=1e-7)
    for name in ("chi2", "chi2_batch"):
        assert codec.decode_chi2(read(name)).chi2 == pytest.approx(dense.chi2(), rel=1e-9)
    assert codec.decode_chi2(read("chi2_batch")).batch == pytest.approx(dense.chi2(), rel=1e-9)
    accepted = codec.decode_accepted(read("accepted_more"))
    assert isinstance(accepted, Accepted)
    assert accepted.first_factor == 7
    assert accepted.report["chi2"] == pytest.approx(dense.chi2(), rel=1e-9)


def test_deltas_lead_to_the_estimate_bit_for_bit() -> None:
    first, second = (codec.decode_delta(read(name)) for name in ("delta", "delta_more"))
    assert isinstance(first, Delta)
    assert (first.previous, first.revision, second.previous, second.revision) == (0, 1, 1, 2)
    rows: dict[int, bytes] = {}
    for message in (first, second):
        for group in message.variables:
            rows.update(zip(group.keys.tolist(), (row.tobytes() for row in group.values), strict=True))
    estimate = codec.decode_estimate(read("estimate"))
    assert rows == {
        key: row.tobytes()
        for group in estimate.variables
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }


def test_covariances_are_those_of_the_map(known: DenseCovariance) -> None:
    check_blocks(asked.decode_covariances(read("covariances")).groups, known, rtol=1e-7, atol=1e-11)
    joint = asked.decode_covariances(read("covariances_joint"))
    np.testing.assert_allclose(joint.covariance, known.joint(joint.keys.tolist()), rtol=1e-7, atol=1e-11)
    check_cross(asked.decode_covariances(read("covariances_cross")), known, rtol=1e-7, atol=1e-11)


def test_gates_gains_and_pairs_are_those_of_the_map(known: DenseCovariance) -> None:
    gate, gated = asked.decode_ask_gate(read("ask_gated")), asked.decode_gated(read("gated"))
    check_candidates(gate, gated, asked.decode_gained(read("gained")), known, 1e-7)
    check_pairs(
        asked.decode_ask_associate(read("ask_associated")), asked.decode_associated(read("associated")), known, 1e-7
    )


def test_why_is_what_the_equations_say(known: DenseCovariance) -> None:
    check_factor(asked.decode_why(read("why_factor")).factor, known, 1e-7, 1e-5)
    variable = asked.decode_why(read("why_variable")).variable
    block = known.joint([variable["key"]])
    np.testing.assert_allclose(variable["covariance"], block, rtol=1e-7, atol=1e-11)
    np.testing.assert_allclose(variable["sigmas"], np.sqrt(np.diag(block)), rtol=1e-7)


def test_what_is_repaired_is_false(dense: DenseGraph) -> None:
    content = msgpack.unpackb(read("repaired"))
    (false,) = np.frombuffer(content["factors"], "<i8").tolist()
    (distance,) = np.frombuffer(content["distance"], "<f8")
    repaired = DenseGraph()
    for name in ("insert", "insert_more"):
        repaired.add(codec.decode_insert(read(name)).batch)
    repaired.put(codec.decode_insert(read("insert")).batch.variables)
    repaired.factors.pop(false), repaired.losses.pop(false)
    assert repaired.gauss_newton(100) < 1e-10
    kind, keys, z, W = dense.factors[false]
    r = residual(kind, [repaired.values[key] for key in keys], z)
    assert distance == pytest.approx(r @ W @ r, rel=1e-3)
    assert rho("geman-mcclure", 3.0, distance) < distance


def test_a_marginal_says_what_it_stands_for() -> None:
    graph = codec.decode_graph(read("graph_marginal"))
    assert isinstance(graph, MapGraph)
    marginal = DenseGraph()
    marginal.add(graph.batch)
    marginal.put(graph.batch.variables)
    assert any(kind.startswith("linear") for kind, *_ in marginal.factors)
    known = DenseCovariance(marginal)
    check_blocks(asked.decode_covariances(read("covariances_marginal")).groups, known, rtol=1e-6, atol=1e-10)


def test_every_message_that_a_client_meets_is_among_the_vectors() -> None:
    """Those that a client's author had missed: each has what he looked for in it."""
    assert asked.decode_why(read("why_variable")).variable["factors"]
    assert codec.decode_delta(read("delta")).previous == 0
    graph = codec.decode_graph(read("graph")).batch.factors
    assert {group.loss for group in graph} == {"", "huber", "geman-mcclure"}
    assert any(group.kind.startswith("linear_") for group in codec.decode_graph(read("graph_marginal")).batch.factors)
    losses = codec.decode_insert((ROOT / "insert_losses.msgpack").read_bytes()).batch.factors
    assert {group.loss for group in losses} == set(LOSSES)
    assert not codec.decode_accepted((ROOT / "accepted_without_report.msgpack").read_bytes()).report
    row, maps = codec.decode_map(read("row")), codec.decode_map(read("admin_maps"))
    assert set(row) >= {"name", "mode", "epoch", "revision", "variables", "factors", "state", "converged", "protocol"}
    assert [each["name"] for each in maps["maps"]] == [row["name"]]
    assert {"service", "version", "maps", "workers", "memory"} <= set(codec.decode_map(read("admin_stats")))
    assert {"clients", "inserts", "steps", "options", "converging"} <= set(codec.decode_map(read("stats")))


def test_the_export_is_of_the_estimate() -> None:
    export = codec.decode_map(read("export"))
    assert (set(export), export["format"]) == ({"epoch", "revision", "format", "text", "notes"}, "tum")
    poses = {
        key & 0xFFFF: row
        for group in codec.decode_estimate(read("estimate")).variables
        if group.kind == "se2"
        for key, row in zip(group.keys.tolist(), group.values, strict=True)
    }
    rows = [[float(word) for word in line.split()] for line in export["text"].splitlines()]
    assert sorted(int(row[0]) for row in rows) == sorted(poses)
    for number, x, y, z, *q in rows:
        np.testing.assert_allclose([x, y, 2 * np.arctan2(q[2], q[3])], poses[int(number)], atol=1e-12)
        assert (z, q[0], q[1]) == (0.0, 0.0, 0.0)
