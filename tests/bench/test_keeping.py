"""The small forms of `factorbus bench journal`, `bench soak` and `bench mixed`."""

import argparse
from pathlib import Path

import pytest
from bench import journal, mixed, soak


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


@pytest.mark.timeout(300)
def test_six_clients_that_do_everything_leave_memory_and_files_as_they_were(tmp_path: Path) -> None:
    result = mixed.run(argparse.Namespace(rounds=3, round_s=1.0, minutes=0.0, clients=6, seed=8), tmp_path)
    assert (result["faults"], result["same_bits"]) == ([], True)
    assert result["maps_after_the_kill"] >= 3, "those that nobody was about to make anew"
    assert len(result["memory_mb"]) == 2
    assert max(result["memory_mb"]) < min(result["memory_mb"]) + 25, "MB, with no map"
    assert set(result["files_on_disk"]) == {1}, "of maps that were dropped there is nothing: the lock alone"
    assert max(result["open_files"]) <= min(result["open_files"]) + 3
    assert set(result["done"]) >= {"insert", "ask", "change"}
    assert set(result["codes"]) <= mixed.EXPECTED
    assert not mixed.held(result | {"growth": 1.5})
