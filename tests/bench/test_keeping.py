"""The small forms of `factorbus bench journal` and `bench soak`."""

import argparse
from pathlib import Path

import pytest
from bench import journal, soak


@pytest.mark.timeout(300)
def test_what_a_journal_costs_is_measured_in_turn(tmp_path: Path) -> None:
    result = journal.run(blocks=3, inserts=60, window=32, folder=tmp_path)
    assert set(result["inserts_per_s"]) == set(journal.KINDS)
    assert all(rate > 0 for rate in result["inserts_per_s"].values())
    assert result["inserts_per_commit"] > 1, "what waits while the disk is busy goes into one commit"


@pytest.mark.timeout(300)
def test_clients_that_leave_and_are_killed_lose_nothing(tmp_path: Path) -> None:
    options = argparse.Namespace(inserts=2500, clients=3, minutes=3.0, rotate=900, durability="commit")
    result = soak.run(options, tmp_path)
    assert (result["lost"], result["duplicated"]) == (0, 0)
    assert result["inserts"] >= 2500
    assert result["kills"] >= result["maps"] > 1
