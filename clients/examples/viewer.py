"""Print what changes in a map, as it changes, until interrupted or the map has reached a revision.

In one terminal  `factorbus serve`
in another       `python clients/examples/viewer.py [ENDPOINT] [MAP] [UNTIL_REVISION]`
"""

import argparse
import os
import threading

from factorbus.client import connect
from factorbus.proto.messages import Delta

parser = argparse.ArgumentParser(description="Print what changes in a map, as it changes.")
parser.add_argument("endpoint", nargs="?", default=os.environ.get("FACTORBUS_ENDPOINT", "tcp/127.0.0.1:7447"))
parser.add_argument("map", nargs="?", default="square")
parser.add_argument("until_revision", nargs="?", type=int, default=0)
given = parser.parse_args()
there = threading.Event()


def show(delta: Delta) -> None:
    """Called on the mirror's thread: keep it short."""
    counts = ", ".join(f"{len(group.keys)} {group.kind}" for group in delta.variables) or "nothing"
    what = "whole estimate" if delta.previous == 0 else f"since {delta.previous}"
    print(
        f"revision {delta.revision} ({what}): {counts}; chi2 {delta.report.get('chi2', float('nan')):.3f}", flush=True
    )
    if 0 < given.until_revision <= delta.revision:
        there.set()


with connect(given.endpoint, client="viewer") as bus, bus.map(given.map) as joined:
    joined.estimate.on_delta(show)
    print(f"map {given.map} at revision {joined.estimate.revision}: {len(joined.estimate)} variables", flush=True)
    if not 0 < given.until_revision <= joined.estimate.revision:
        there.wait()
