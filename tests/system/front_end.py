"""A front end in a process of its own: drives a noisy loop into a map, several inserts in flight.

front_end.py ENDPOINT MAP LETTER POSES     then a line `go` → `done LAST-REVISION`, when the map has come to rest
"""

import sys

import numpy as np

from factorbus.client import Draft, connect

SIGMAS = (0.1, 0.1, 0.02)


def main() -> None:
    endpoint, name, letter, poses = sys.argv[1:]
    random = np.random.default_rng(ord(letter))
    with connect(endpoint, client=letter, timeout_s=60) as bus, bus.map(name, window=8) as driven:
        print("ready", flush=True)
        sys.stdin.readline()
        driven.insert(Draft().se2(f"{letter}0", (ord(letter), 0, 0), fixed=True), timeout_s=60)
        for n in range(1, int(poses)):
            driven.send(draft(letter, n, random), timeout_s=60)
        driven.wait_converged(60)
        print("done", driven.estimate.revision, flush=True)


def draft(letter: str, n: int, random: np.random.Generator) -> Draft:
    """Pose n, its odometry, and every tenth pose an edge far back."""
    made = (
        Draft()
        .se2(f"{letter}{n}")
        .between_se2(f"{letter}{n - 1}", f"{letter}{n}", random.normal((1.0, 0.0, 0.3), 0.02), sigmas=SIGMAS)
    )
    if n % 10 == 0:
        made.between_se2(f"{letter}{n - 9}", f"{letter}{n}", random.normal((0.5, 1.5, 2.7), 0.02), sigmas=SIGMAS)
    return made


if __name__ == "__main__":
    main()
