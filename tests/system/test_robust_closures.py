"""A service that weighs loop closures: what a robot and an operator see; killed, forked and verified."""

import json
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from false_closures import drive_with_false
from journalled import Services
from processes import PATIENCE_S
from tested_service import ran, told, values

from factorbus.cli.driving.columns import merged
from factorbus.client import Changes, connect
from factorbus.formats import read, write_graph


def test_a_drive_whose_closures_are_weighed(services: Callable[..., Services], tmp_path: Path) -> None:
    drive = drive_with_false(260, 2, 0.4, "random")
    running = services(tmp_path / "journal", 'closures="robust"', "checkpoint_s=0.1")
    endpoint = running.start()
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("yard") as joined:
        accepted = [joined.insert(batch) for batch in drive.batches]
        assert sum(each.report.get("closures", 0) for each in accepted) == drive.is_false().size
        assert (joined.closures, joined.stats()["closures"]) == ("robust", "robust")
        found = joined.suspects(every=True)
        is_in = np.array([state == "accepted" for state in found.states])
        assert not (is_in & drive.is_false()).any()
        assert is_in.sum() > 10
        assert found.weight is not None
        assert ((found.weight >= 0.25) == is_in).all()

        listed = json.loads(ran("ask", "suspects", "yard", "--connect", endpoint, "--json"))
        out = [row["factor"] for row in listed["listed"]]
        assert (listed["closures"], out) == ("robust", found.factors[~is_in].tolist())
        assert all(row["weight"] < 0.25 for row in listed["listed"])
        assert "weight" in ran("ask", "suspects", "yard", "--connect", endpoint)
        assert "closures are weighed" in ran("stats", "yard", "--connect", endpoint)
        assert "closures weighed" in ran("maps", "--connect", endpoint)

        written = tmp_path / "yard.g2o"
        saved = json.loads(ran("save", "yard", str(written), "--connect", endpoint, "--json"))
        missing = sum(row["reason"] == "outweighed" for row in listed["listed"])
        assert saved["left_out"]["loop closures"] == missing
        assert f"{missing} loop closures left out: the estimate does not have them" in saved["notes"][0]
        assert read(written).batch.factor_count == sum(b.factor_count for b in drive.batches) - missing

        joined.change(Changes().accept(out[0]).reject(int(found.factors[is_in][0])))
        fork = bus.fork("yard", "what-if")
        assert fork.closures == "robust"
        joined.wait_converged(PATIENCE_S)
        before, held = told(joined), values(joined)
        assert before[out[0]] == ("restored", "user")
        running.end(signal.SIGKILL)
        running.start()
        with bus.map("yard", create=False) as again:
            assert (told(again), values(again)) == (before, held)
    running.end(signal.SIGTERM)
    verified = ran("journal", "verify", "--journal", str(tmp_path / "journal"))
    assert {"what-if", "yard"} <= {line.partition(":")[0] for line in verified.splitlines() if "to the bit" in line}


@pytest.mark.parametrize("policy", ["test", "robust"])
def test_a_file_of_a_replay_says_which_closures_it_lacks(tmp_path: Path, policy: str) -> None:
    drive = drive_with_false(120, 2, 0.4, "random")
    write_graph(tmp_path / "in.g2o", merged(drive.batches))
    options = "--closures", policy, "--out", str(tmp_path / "out.g2o"), "--json"
    replayed = json.loads(ran("replay", str(tmp_path / "in.g2o"), *options))
    there = [read(tmp_path / name).batch.factor_count for name in ("in.g2o", "out.g2o")]
    assert replayed["left_out"]["loop closures"] == there[0] - there[1] > 0
