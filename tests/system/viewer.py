"""A viewer in a process of its own: mirrors a map, and says what it has when asked.

viewer.py ENDPOINT MAP      then lines `show REVISION` → `has REVISION SHA256-of-the-estimate`
"""

import hashlib
import sys

import numpy as np

from factorbus.client import connect
from factorbus.client.map import Map


def digest(shown: Map) -> str:
    """One hash over keys and values, in the order of the keys."""
    content = hashlib.sha256()
    keys, values = shown.estimate.columns("se2")
    order = np.argsort(keys)
    content.update(keys[order].tobytes() + values[order].tobytes())
    return content.hexdigest()


def main() -> None:
    endpoint, name = sys.argv[1:]
    with connect(endpoint, client="viewer", timeout_s=60) as bus, bus.map(name) as shown:
        print("ready", flush=True)
        for line in sys.stdin:
            shown.estimate.wait_for(int(line.split()[1]), timeout_s=60)
            print("has", shown.estimate.revision, digest(shown), flush=True)


if __name__ == "__main__":
    main()
