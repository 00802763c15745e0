"""A map that goes out as g2o and comes back in another service's map is the same map."""

from pathlib import Path

import numpy as np
import pytest

from factorbus.cli.driving.columns import merged
from factorbus.client import connect
from factorbus.formats import g2o_text, read, write_g2o
from factorbus.proto.messages import Batch
from factorbus.simulate import city_trees, sphere


@pytest.mark.parametrize("world", [city_trees, sphere])
def test_over_the_bus_values_factors_and_chi2_survive(world, endpoint: str, tmp_path: Path) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus:
        with bus.map(f"out-{world.__name__}") as first:
            first.insert(merged(step.batch for step in world(poses=150, seed=6)), settle=True)
            path = tmp_path / "map.g2o"
            path.write_text(first.export("g2o"))
            chi2, graph = first.chi2().chi2, first.graph().batch
        back = read(path)
        with bus.map(f"in-{world.__name__}") as second:
            second.insert(back.whole(use_values=True))
            again = second.graph().batch
            assert second.chi2().chi2 == pytest.approx(chi2, rel=1e-9)
    for before, after in zip(graph.factors, back.batch.factors, strict=True):
        assert before.kind == after.kind
        np.testing.assert_array_equal(before.measured, after.measured)
        np.testing.assert_array_equal(before.information, after.information)
    # What was settled stays where it is: iterating on from there moves nothing by more than it would at home.
    for before, after in zip(by_kind(graph), by_kind(again), strict=True):
        apart = np.abs(before[:, None] - after[None]).max(axis=2)
        assert apart.min(axis=1).max() < 1e-6
        assert apart.min(axis=0).max() < 1e-6


def by_kind(batch: Batch) -> list[np.ndarray]:
    """Values, a kind at a time.  Names change where g2o has no letters, so rows are found by what they hold."""
    free = Batch(tuple(group._replace(fixed=False) for group in batch.variables))
    return [group.values for group in merged([free]).variables if group.values is not None]


@pytest.mark.data
def test_every_public_graph_is_written_and_read_back_bit_for_bit(datasets: Path, tmp_path: Path) -> None:
    files = sorted(datasets.glob("*.g2o"))
    assert len(files) >= 11
    for path in files:
        graph = read(path).batch
        copy = tmp_path / path.name
        write_g2o(copy, graph)
        again = read(copy).batch
        assert g2o_text(again) == copy.read_text()
        assert [g.kind for g in again.factors] == [g.kind for g in graph.factors]
        for before, after in zip((*graph.variables, *graph.factors), (*again.variables, *again.factors), strict=True):
            for one, other in zip(before[1:], after[1:], strict=True):
                np.testing.assert_array_equal(one, other)
        copy.unlink()
