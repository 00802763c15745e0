"""The parts of a map that nothing joins, as a client and a shell see them until a robot is attached, and after that."""

import asyncio
import json
import subprocess
import sys

import numpy as np

from factorbus.client import Draft, Map, attach, connect
from factorbus.client.aio import connect as connect_aio

ODOMETRY, SEEN = (0.05, 0.05, 0.01), (0.1, 0.1, 0.05)


def drive(into: Map, letter: str, length: int) -> None:
    way = Draft().se2(f"{letter}0", (0, 0, 0), fixed=True)
    for n in range(1, length):
        way.se2(f"{letter}{n}").between_se2(f"{letter}{n - 1}", f"{letter}{n}", (1, 0, 0.1), sigmas=ODOMETRY)
    into.insert(way)


def command(endpoint: str, *rest: str) -> str:
    line = [sys.executable, "-P", "-m", "factorbus.cli", *rest, "--connect", endpoint]
    ran = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_two_until_the_first_is_attached(endpoint: str) -> None:
    with connect(endpoint, client="matcher", timeout_s=60) as bus, bus.map("hall") as hall:
        assert hall.components().count == 0
        drive(hall, "x", 20)
        drive(hall, "y", 12)
        found = hall.components()
        assert (found.epoch, found.revision, found.count) == (hall.epoch, hall.estimate.revision, 2)
        assert [(dict(c.letters), c.factors, dict(c.held), c.own_frame) for c in found.listed] == [
            ({"x": 20}, 19, {"fixed": 1}, True),
            ({"y": 12}, 11, {"fixed": 1}, True),
        ]
        asked = json.loads(command(endpoint, "ask", "components", "hall", "--json"))
        assert (asked["count"], [part["first"] for part in asked["components"]]) == (2, ["x0", "y0"])
        shown = command(endpoint, "ask", "components", "hall")
        assert "y  " in shown
        assert "12 variables, the first y0, 11 factors; held by 1 fixed: in a frame of its own" in shown
        of_all = command(endpoint, "stats", "hall")
        assert "2 components that no factor joins, 2 in a frame of its own: x (20 variables); y (12" in of_all
        assert "components" not in command(endpoint, "stats"), "asked of one map alone"
        candidates = Draft()
        for n in range(2, 12, 2):
            candidates.between_se2(f"x{n + 5}", f"y{n}", np.random.default_rng(n).normal(0, SEEN), sigmas=SEEN)
        assert attach(hall, "y", candidates).accepted
        (one,) = hall.components().listed
        assert (dict(one.letters), dict(one.held)) == ({"x": 20, "y": 12}, {"fixed": 1})
        assert "its own" not in command(endpoint, "ask", "components", "hall")
        assert "one component: all of it hangs together" in command(endpoint, "stats", "hall")


def test_from_a_loop(endpoint: str) -> None:
    async def ask() -> int:
        async with connect_aio(endpoint, client="loop") as bus, bus.map("yard") as yard:
            await yard.insert(Draft().se2("x0", (0, 0, 0), fixed=True).se2("y0", (0, 0, 0), fixed=True))
            return (await yard.components()).count

    assert asyncio.run(ask()) == 2
