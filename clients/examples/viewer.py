"""Print what changes in a map, as it changes, until interrupted or the map has reached a revision.

In one terminal  `factorbus serve`
in another       `python clients/examples/viewer.py [ENDPOINT] [MAP] [UNTIL_REVISION]`
"""

import os
import sys
import threading

from factorbus.client import connect
from factorbus.proto.messages import Delta

DEFAULTS = [os.environ.get("FACTORBUS_ENDPOINT", "tcp/127.0.0.1:7447"), "square", "0"]
ENDPOINT, MAP, UNTIL = [*sys.argv[1:], *DEFAULTS[len(sys.argv) - 1 :]]
there = threading.Event()


def show(delta: Delta) -> None:
    """Called on the mirror's thread: keep it short."""
    counts = ", ".join(f"{len(group.keys)} {group.kind}" for group in delta.variables) or "nothing"
    what = "whole estimate" if delta.previous == 0 else f"since {delta.previous}"
    print(
        f"revision {delta.revision} ({what}): {counts}; chi2 {delta.report.get('chi2', float('nan')):.3f}", flush=True
    )
    if 0 < int(UNTIL) <= delta.revision:
        there.set()


with connect(ENDPOINT, client="viewer") as bus, bus.map(MAP) as joined:
    joined.estimate.on_delta(show)
    print(f"map {MAP} at revision {joined.estimate.revision}: {len(joined.estimate)} variables", flush=True)
    if not 0 < int(UNTIL) <= joined.estimate.revision:
        there.wait()
