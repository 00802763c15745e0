"""The steps of a simulated world, pickled one after another to standard output, for who wants to hold no world itself.

python -m bench.replays.feed NAME POSES SEED

Each is read whole, and made of its bytes when it is asked for: as a message that has just come in it is in the caches.
But many are read at a time, for to wait for one is to let the process that makes them have the core, if it is on the
same one, and with it the caches: the median step then took a tenth to a quarter more.
"""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS

from .problems import Problem

_LENGTH = 8  # bytes that say how long a step is
_AHEAD = 1000  # steps


@contextmanager
def fed(problem: Problem) -> Iterator[Iterator[Batch]]:
    """The steps of a world, made by another process as they are asked for."""
    command = [sys.executable, "-m", "bench.replays.feed", problem.name, str(problem.poses), str(problem.seed)]
    paths = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": paths}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment) as feeder:
        assert feeder.stdout is not None
        try:
            yield _received(feeder.stdout, problem.poses)
        finally:
            feeder.kill()


def main() -> None:
    """Write all steps."""
    name, poses, seed = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    for step in WORLDS[name](poses, seed):
        message = pickle.dumps(step.batch, protocol=5)
        sys.stdout.buffer.write(len(message).to_bytes(_LENGTH, "little") + message)


def _received(pipe: BinaryIO, count: int) -> Iterator[Batch]:
    for first in range(0, count, _AHEAD):
        read = range(first, min(first + _AHEAD, count))
        for message in [pipe.read(int.from_bytes(pipe.read(_LENGTH), "little")) for _ in read]:
            yield pickle.loads(message)


if __name__ == "__main__":
    main()
