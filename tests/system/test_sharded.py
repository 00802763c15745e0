"""The operator's walk of deploy/README.md: maps spread over services by name, one map moved, one service restarted."""

import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from processes import Process

from factorbus.client import Draft, connect
from factorbus.proto.problems import Problem

Spawn = Callable[..., Process]
ROUTER = str(Path(__file__).parent / "router.py")
SIGMAS = (0.1, 0.1, 0.02)


def serve(spawn: Spawn, router: str, shard: int) -> Process:
    options = ("--mode", "client", "--connect", router, "--name", f"solver-{shard}", "--maps", f"shard{shard}-*")
    service = spawn("-m", "factorbus.service", *options, "--no-warm")
    service.line("ready")
    return service


def test_spread_move_and_restart(spawn: Spawn) -> None:
    router = spawn(ROUTER, "tcp/127.0.0.1:0").ready()[0]
    services = [serve(spawn, router, shard) for shard in (0, 1)]
    spawn("-m", "factorbus.workers", "--connect", router, "--name", "worker1", "--no-warm").ready()
    with connect(router, client="robot1", timeout_s=300) as bus:
        with bus.map("shard0-hall") as hall, bus.map("shard1-yard") as yard:
            for driven in (hall, yard):
                driven.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
                for n in range(1, 20):
                    driven.insert(Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0.1), sigmas=SIGMAS))
        assert {row.name for row in bus.maps()} == {"shard0-hall", "shard1-yard"}
        where = {row["service"]: [each["name"] for each in row["maps"]] for row in bus.stats()}
        assert where == {"solver-0": ["shard0-hall"], "solver-1": ["shard1-yard"]}

        # Move: its front ends have left; the graph goes to the other shard under a name of its own; drop.
        with bus.map("shard0-hall", create=False) as old, bus.map("shard1-hall") as new:
            old.wait_converged()  # which makes no further step by itself
            graph = old.graph()
            new.insert(graph.batch)
            new.settle()
            assert old.stats()["revision"] == graph.revision, "nobody inserted meanwhile"
            for kind in ("se2",):
                (keys, values), (moved_keys, moved) = old.estimate.columns(kind), new.estimate.columns(kind)
                assert np.array_equal(keys, moved_keys)
                assert np.allclose(values, moved, atol=1e-9)
            assert new.chi2(batch=True).batch == pytest.approx(old.chi2().chi2, abs=1e-12)
        bus.drop("shard0-hall")
        assert {row.name for row in bus.maps()} == {"shard1-yard", "shard1-hall"}

        # Drain and restart: what was accepted is answered; the other service does not notice.
        services[0].signal(signal.SIGTERM)
        assert services[0].wait() == 0
        with bus.map("shard1-yard", create=False) as yard:
            assert yard.insert(Draft().between_se2("x0", "x19", (5, 5, 0.3), sigmas=SIGMAS)).revision == 21
        with pytest.raises(Problem), connect(router, client="robot1", timeout_s=0.5) as late:
            late.map("shard0-hall")
        serve(spawn, router, 0)
        with bus.map("shard0-hall") as again:
            assert again.insert(Draft().se2("x0", (0, 0, 0), fixed=True)).revision == 1
