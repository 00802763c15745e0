"""A drive whose heading has drifted, and the loop that closes then: too much turns for one step to finish."""

import math
from collections.abc import Iterator
from pathlib import Path

from factorbus.client import Draft
from factorbus.journal.store import create
from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver


def drive(poses: int, degrees: float) -> Iterator[Batch]:
    """A circle of so many poses, one a step, which ends `degrees` too far round."""
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
    options = Options(mode=mode, nonmonotone_steps=0).as_dict()
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
