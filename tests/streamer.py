"""A front end in a process of its own that streams whatever the network does.

streamer.py ENDPOINT MAP COUNT     then lines `more N` → `answered N SECONDS-OF-THE-LAST`; `end` → `done SHA256`
"""

import sys
import time

from journalled import PATIENCE_S, Stream, drafts
from system.viewer import digest

from factorbus.client import connect


def main() -> None:
    endpoint, name, count = sys.argv[1:]
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map(name, "inc-l", window=32) as driven:
        stream = Stream(driven, drafts(int(count)))
        stream.start()
        print("ready", flush=True)
        allowed = 0
        for line in sys.stdin:
            word, *numbers = line.split()
            if word == "end":
                break
            allowed += int(numbers[0])
            begun = time.monotonic()
            stream.allow(int(numbers[0]))
            stream.wait_for(allowed)
            print("answered", allowed, f"{time.monotonic() - begun:.2f}", flush=True)
        driven.wait_converged(PATIENCE_S)
        assert not stream.fault
        print("done", driven.estimate.revision, digest(driven), flush=True)


if __name__ == "__main__":
    main()
