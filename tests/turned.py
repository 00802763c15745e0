"""A drive whose heading has drifted, and the loop that closes then: too much turns for one step to finish."""

import math
import threading
from collections.abc import Iterator
from pathlib import Path

from processes import PATIENCE_S

from factorbus.client import Draft, Map
from factorbus.journal.store import create
from factorbus.proto.messages import Batch, Delta
from factorbus.service.solving.apply import GOES_ON
from factorbus.solver import Options, Solver

# The first finishes in a few steps, the second in hundreds of short ones.
SHORT, LONG = (200, 90.0), (1000, 90.0)


class Deltas:
    """What is published of a map from now on."""

    def __init__(self, joined: Map) -> None:
        self.all: list[Delta] = []
        self._more = threading.Condition()
        joined.estimate.on_delta(self._take)

    def _take(self, delta: Delta) -> None:
        with self._more:
            self.all.append(delta)
            self._more.notify_all()

    def wait_for_further(self, count: int) -> None:
        with self._more:
            assert self._more.wait_for(lambda: len(self.further()) >= count, PATIENCE_S)

    def further(self) -> list[Delta]:
        return [delta for delta in self.all if str(delta.report.get("because")).startswith(GOES_ON)]


def turn(joined: Map, size: tuple[int, float]) -> Deltas:
    """The drive, and then the loop; what comes from that on."""
    poses, _ = size
    joined.insert(in_one(*size))
    joined.wait_converged(PATIENCE_S)
    deltas = Deltas(joined)
    joined.insert(closing(poses))
    return deltas


def drive(poses: int, degrees: float) -> Iterator[Batch]:
    """A circle of a number of poses, one a step, which ends `degrees` too far round."""
    yield _first(Draft()).batch()
    for n in range(1, poses):
        yield _next(Draft(), n, poses, degrees).batch()


def in_one(poses: int, degrees: float) -> Batch:
    """The same as one batch."""
    draft = _first(Draft())
    for n in range(1, poses):
        _next(draft, n, poses, degrees)
    return draft.batch()


def closing(poses: int) -> Batch:
    """The last pose is where the first one is."""
    return Draft().between_se2(f"x{poses - 1}", "x0", (0, 0, 0), sigmas=(0.1, 0.1, 0.05)).batch()


def prepare(journals: Path, name: str, mode: str) -> None:
    """An empty map in a folder of journals, whose solver may only go downhill: there it takes hundreds of steps."""
    journals.mkdir(parents=True, exist_ok=True)
    options = Options.of(mode=mode, max_nonmonotone_steps=0).as_dict()
    create(journals / name, name, mode, options, epoch=7, durability="none").close()


def optimum(poses: int, degrees: float) -> float:
    """χ² of it all at its optimum."""

    solver = Solver(Options(mode="all-batch"))
    for batch in (*drive(poses, degrees), closing(poses)):
        solver.stage(batch)
    while not (report := solver.step(settle=True)).converged:
        pass
    return report.chi2


def _first(draft: Draft) -> Draft:
    return draft.se2("x0", (0, 0, 0), fixed=True)


def _next(draft: Draft, n: int, poses: int, degrees: float) -> Draft:
    turn = (2 * math.pi + math.radians(degrees)) / (poses - 1)
    draft.se2(f"x{n}")
    return draft.between_se2(f"x{n - 1}", f"x{n}", (1, 0, turn), sigmas=(0.05, 0.05, 0.03))
