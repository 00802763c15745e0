"""Large blocks that were freed go back to the system, whatever small ones came after them."""

import subprocess
import sys

import pytest

# Arrays that double as a map grows, freed while small things that stay have been put behind each: in threads, as in
# the service.  What is left of them is printed, in MiB.
HELD_IN_PLACE = """
import sys, threading
import numpy as np
from factorbus.service.process.heap import lay_out_heaps

if sys.argv[1] == "laid out":
    assert lay_out_heaps()

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096

def grow():
    for _ in range(20):
        large = np.ones(4 << 17)
        kept.append(np.ones(1000))
        del large

kept = []
before = resident()
for _ in range(8):
    large = [np.ones((4 << 17) + n) for n in range(8)]
    while large:
        kept.append(np.ones(4000))
        large.pop(0)
    worker = threading.Thread(target=grow)
    worker.start()
    worker.join()
print((resident() - before - sum(each.nbytes for each in kept)) >> 20)
"""


def left_behind(how: str) -> int:
    command = [sys.executable, "-c", HELD_IN_PLACE, how]
    return int(subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="needs glibc's mallopt and /proc")
def test_what_large_blocks_leave_behind_is_given_back() -> None:
    assert left_behind("laid out") < 8
    assert left_behind("as the C library likes") > 24, "it would be like that without asking"
