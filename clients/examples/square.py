"""A robot drives a square and sees its start again: the smallest real integration.

In one terminal  `factorbus serve`
in another       `python clients/examples/square.py [ENDPOINT] [MAP]`
"""

import argparse
import math
import os
import sys

from factorbus.client import Draft, connect

parser = argparse.ArgumentParser(description="A robot drives a square and sees its start again.")
parser.add_argument("endpoint", nargs="?", default=os.environ.get("FACTORBUS_ENDPOINT", "tcp/127.0.0.1:7447"))
parser.add_argument("map", nargs="?", default="square")
given = parser.parse_args()
SIGMAS = (0.1, 0.1, 0.02)  # metres, metres, radians

with connect(given.endpoint, client="robot1") as bus, bus.map(given.map) as square:
    if square.estimate.revision > 0:
        sys.exit(f"map {given.map} has been driven already; name another one, or `factorbus drop {given.map}`")
    square.insert(Draft().se2("x0", (0, 0, 0), fixed=True))
    for i in range(1, 5):  # 10 m ahead, a left turn that the odometry takes for 92 degrees
        turn = (10, 0, math.radians(92))
        square.insert(Draft().se2(f"x{i}").between_se2(f"x{i - 1}", f"x{i}", turn, sigmas=SIGMAS))
    print("by odometry the robot is at", square.estimate["x4"].round(3))
    accepted = square.insert(Draft().between_se2("x0", "x4", (0, 0, 0), sigmas=SIGMAS))  # it recognizes its start
    print("after the loop closure at  ", square.estimate["x4"].round(3), f"(chi2 {accepted.report['chi2']:.3f})")
