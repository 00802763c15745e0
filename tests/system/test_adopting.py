"""A map in a worse minimum says so, and is put into the best one: over the bus, by the command line, over a restart."""

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from processes import Process

from factorbus.client import Changes, Draft, Map, Refused, aio, connect

POSES = 16
SIGMAS = (0.1, 0.1, 0.02)


def wound(letter: str = "x") -> Draft:
    """A ring of exact relative poses, whose values are wound once too often: a minimum of its own."""
    turn, draft = 2 * np.pi / POSES, Draft().se2(f"{letter}0", (0, 0, 0), fixed=True)
    for i in range(1, POSES):
        draft.se2(f"{letter}{i}", (0, 0, float(np.angle(np.exp(2j * turn * i)))))
    step = (np.cos(turn / 2) * 2 * np.sin(turn / 2), 2 * np.sin(turn / 2) ** 2, turn)
    for i in range(POSES):
        draft.between_se2(f"{letter}{i}", f"{letter}{(i + 1) % POSES}", step, sigmas=SIGMAS)
    return draft


def beside(joined: Map, key: str) -> None:
    """A new pose that only the ring's ninth holds."""
    joined.insert(Draft().se2(key).between_se2("x8", key, (0.5, 0.25, 1.0), sigmas=SIGMAS))


def relative(joined: Map, key: str) -> np.ndarray:
    x, y, theta = joined.estimate["x8"]
    there = joined.estimate[key]
    c, s = np.cos(theta), np.sin(theta)
    dx, dy = there[0] - x, there[1] - y
    return np.array([c * dx + s * dy, c * dy - s * dx, np.angle(np.exp(1j * (there[2] - theta)))])


def test_a_worse_minimum_is_told_and_left(endpoint: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("wound") as joined:
        joined.insert(wound(), settle=True)
        found = joined.chi2(batch=True, values=True)
        assert found.chi2 > 1.0
        assert found.batch is not None
        assert found.batch < 1e-12
        assert found.start in ("odometry", "rotations")
        assert found.notice is not None
        assert (found.notice.code, found.notice.detail["start"]) == ("better_optimum", found.start)
        assert not joined.chi2(batch=True).variables, "only who asks for the values gets them"
        # Meanwhile the map goes on: what is new stays where it is to what it hangs on.
        before = joined.ask_estimate()
        beside(joined, "x50")
        adopted = joined.change(Changes().adopt(found), settle=True)
        assert adopted.report["placed_variables"] == POSES
        assert adopted.report["chi2"] < 1e-9
        np.testing.assert_allclose(relative(joined, "x50"), (0.5, 0.25, 1.0), atol=1e-6)
        again = joined.chi2(batch=True)
        assert (again.notice, again.start) == (None, "values")
        # It is a change as any other: what was there before can be placed again.
        joined.change(Changes().place(before.variables), settle=True)
        assert joined.chi2().chi2 == pytest.approx(found.chi2, rel=1e-6)


def test_what_was_removed_meanwhile_is_not_adopted(endpoint: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("wound-less") as joined:
        joined.insert(wound(), settle=True)
        beside(joined, "x50")
        found = joined.chi2(batch=True, values=True)
        joined.change(Changes().remove_variables("x50"))
        with pytest.raises(Refused) as refused:
            joined.change(Changes().adopt(found), settle=True)
        assert refused.value.code == "unknown_variable"
        assert joined.chi2().chi2 == pytest.approx(found.chi2, rel=1e-6), "nothing has changed"


def test_adopted_with_asyncio(endpoint: str) -> None:
    async def run() -> float:
        async with aio.connect(endpoint, client="aio", timeout_s=60) as bus, bus.map("wound-aio") as joined:
            await joined.insert(wound(), settle=True)
            found = await joined.chi2(batch=True, values=True)
            accepted = await joined.change(Changes().adopt(found), settle=True)
            return accepted.report["chi2"]

    assert asyncio.run(run()) < 1e-9


def test_a_restart_has_what_was_adopted(spawn: Callable[..., Process], tmp_path: Path) -> None:
    serve = ("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--journal", str(tmp_path / "journal"))
    service = spawn(*serve)
    with connect(service.ready()[0], client="robot", timeout_s=60) as bus, bus.map("m") as joined:
        joined.insert(wound(), settle=True)
        found = joined.chi2(batch=True, values=True)
        beside(joined, "x50")
        joined.change(Changes().adopt(found), settle=True)
        before = joined.ask_estimate()
    service.signal(signal.SIGKILL)
    service.wait()
    again = spawn(*serve)
    with connect(again.ready()[0], client="robot", timeout_s=60) as bus, bus.map("m", create=False) as joined:
        after = joined.ask_estimate()
        assert (after.epoch, after.revision) == (before.epoch, before.revision)
        for old, now in zip(before.variables, after.variables, strict=True):
            assert (old.keys.tobytes(), old.values.tobytes()) == (now.keys.tobytes(), now.values.tobytes())


def cli(*arguments: str) -> str:
    command = [sys.executable, "-m", "factorbus.cli", *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_the_command_line_says_it_and_does_it(endpoint: str) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("wound-cli") as joined:
        joined.insert(wound(), settle=True)
        told = cli("ask", "chi2", "wound-cli", "--batch", "--connect", endpoint)
        assert "better_optimum" in told
        assert "optimum from" in told
        assert json.loads(cli("ask", "chi2", "wound-cli", "--connect", endpoint, "--json"))["chi2"] > 1.0
        done = json.loads(cli("change", "adopt", "wound-cli", "--connect", endpoint, "--json"))
        assert done["adopted"]
        assert done["chi2"] < 1e-9 < 1.0 < done["chi2_before"]
        again = json.loads(cli("change", "adopt", "wound-cli", "--connect", endpoint, "--json"))
        assert (again["adopted"], again["start"]) == (False, "values")
        assert "better_optimum" not in cli("ask", "chi2", "wound-cli", "--batch", "--connect", endpoint)
