"""A robot under asyncio: inserts in flight while a task prints every change.

In one terminal  `factorbus serve`
in another       `python clients/examples/async_robot.py [ENDPOINT] [MAP]`
"""

import argparse
import asyncio
import os
import sys

from factorbus.client import Draft
from factorbus.client.aio import Map, connect

parser = argparse.ArgumentParser(description="A robot under asyncio: inserts in flight while a task prints.")
parser.add_argument("endpoint", nargs="?", default=os.environ.get("FACTORBUS_ENDPOINT", "tcp/127.0.0.1:7447"))
parser.add_argument("map", nargs="?", default="corridor")
given = parser.parse_args()
POSES = 20


async def main() -> None:
    """Drive straight on, without waiting for each answer."""
    async with connect(given.endpoint, client="robot2") as bus, bus.map(given.map) as corridor:
        if corridor.estimate.revision > 0:
            sys.exit(f"map {given.map} has been driven already; name another one, or `factorbus drop {given.map}`")
        printer = asyncio.create_task(show(corridor))
        await corridor.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
        for i in range(1, POSES):
            step = Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", (1, 0, 0), sigmas=(0.1, 0.1, 0.02))
            await corridor.send(step)  # returns at once while fewer than `window` are unanswered
        await corridor.flush()
        await printer
        print("last pose", corridor.estimate[f"x{POSES - 1}"].round(3), "chi2", (await corridor.chi2()).chi2)


async def show(corridor: Map) -> None:
    """Print changes until the last pose is there."""
    async for delta in corridor.deltas():
        print(f"revision {delta.revision}: {sum(len(group.keys) for group in delta.variables)} values changed")
        if f"x{POSES - 1}" in corridor.estimate:
            return


asyncio.run(main())
