"""The steps of a simulated world, pickled one after another to standard output, for who wants to hold no world itself.

python -m bench.replays.feed NAME POSES SEED
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
        sys.stdout.buffer.write(pickle.dumps(step.batch, protocol=5))


def _received(pipe: BinaryIO, count: int) -> Iterator[Batch]:
    for _ in range(count):
        yield pickle.load(pipe)


if __name__ == "__main__":
    main()
