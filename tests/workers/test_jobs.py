"""What a worker does with a job: the optimum of a graph, or a problem with a code."""

import numpy as np
import pytest
from few_tries import give_up_after
from turned import closing, in_one

from factorbus.cli.driving.columns import merged
from factorbus.proto import codec
from factorbus.proto.messages import Batch, Factors, Job, MapGraph, Variables
from factorbus.proto.problems import Problem
from factorbus.service.jobs.running import do_in_place
from factorbus.simulate import Spiral, sphere
from factorbus.solver import SolverError
from factorbus.workers import jobs
from factorbus.workers.config import WorkerConfig, checked_worker_config

INFORMATION = np.array([[100.0, 0, 0, 100, 0, 400]] * 3)


def triangle() -> MapGraph:
    """Three poses in a row whose three edges do not agree: 1 + 1 ≠ 2.3."""
    start = Variables("se2", np.array([0]), np.zeros((1, 3)), fixed=True)
    free = Variables("se2", np.array([1, 2]), np.array([[1.0, 0, 0], [2, 0, 0]]))
    measured = np.array([[1.0, 0, 0], [1, 0, 0], [2.3, 0, 0]])
    edges = Factors("between_se2", np.array([[0, 1], [1, 2], [0, 2]]), measured, INFORMATION)
    return MapGraph(1, 1, Batch((start, free), (edges,)))


def test_the_batch_job_finds_the_optimum() -> None:
    optimum = codec.decode_optimum(jobs.run_job("batch", codec.encode_graph(triangle())))
    # Three springs of one stiffness share the gap of 0.3 evenly: χ² = 3 · 100 · 0.1².
    assert optimum.chi2 == pytest.approx(3.0, rel=1e-9)
    places = {int(k): row for g in optimum.variables for k, row in zip(g.keys, g.values, strict=True)}  # type: ignore[arg-type]
    np.testing.assert_allclose([places[1], places[2]], [[1.1, 0, 0], [2.2, 0, 0]], atol=1e-9)


def test_the_service_in_place_finds_the_same_bits() -> None:
    payload = codec.encode_graph(triangle())
    done = do_in_place(Job("j", "batch", payload))
    assert done.payload == jobs.run_job("batch", payload)


def test_the_search_on_a_hard_graph_says_that_it_has_not_converged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Much noise of rotation and few loops: more than the 3 tries that are made."""
    world = sphere(200, 1, spiral=Spiral(20, 20), sigma_rotation_rad=0.25, loop_share=0.05, revisit_share=0.0)
    payload = codec.encode_graph(MapGraph(1, 1, merged(step.batch for step in world)))
    whole = codec.decode_optimum(jobs.run_job("batch", payload))
    assert whole.converged
    give_up_after(3, monkeypatch.setattr)
    early = codec.decode_optimum(jobs.run_job("batch", payload))
    assert not early.converged
    assert early.chi2 > 1.0001 * whole.chi2


def test_a_search_that_ends_before_it_has_converged_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """By a worker and in place; here after a single try of each start."""
    drive, loop = in_one(60, 90.0), closing(60)
    payload = codec.encode_graph(MapGraph(1, 1, Batch(drive.variables, drive.factors + loop.factors)))
    whole = codec.decode_optimum(jobs.run_job("batch", payload))
    assert whole.converged
    give_up_after(1, monkeypatch.setattr)
    early = jobs.run_job("batch", payload)
    found = codec.decode_optimum(early)
    assert not found.converged
    assert found.chi2 > 1.0001 * whole.chi2
    assert do_in_place(Job("j", "batch", payload)).payload == early


def test_what_cannot_be_done_has_a_code() -> None:
    loose = MapGraph(1, 1, Batch((Variables("se2", np.array([0]), np.zeros((1, 3))),)))
    for kind, payload, code in (
        ("bake", b"", "unknown_kind"),
        ("batch", b"\xc1", "bad_message"),
        ("batch", codec.encode_graph(loose), "underconstrained"),
    ):
        with pytest.raises((Problem, SolverError)) as refused:
            jobs.run_job(kind, payload)
        assert refused.value.code == code  # type: ignore[attr-defined]


@pytest.mark.parametrize("config", [WorkerConfig(connect=()), WorkerConfig(slots=0), WorkerConfig(name="a/b")])
def test_a_configuration_that_cannot_work_is_refused(config: WorkerConfig) -> None:
    with pytest.raises(Problem):
        checked_worker_config(config)
