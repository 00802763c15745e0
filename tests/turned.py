"""A drive whose heading has drifted, and the loop that closes then: too much turns for one step to finish."""

import math
from collections.abc import Iterator

from factorbus.client import Draft
from factorbus.proto.messages import Batch
from factorbus.solver import Options, Solver


def drive(poses: int, degrees: float) -> Iterator[Batch]:
    """A circle of so many poses, one a step, which ends `degrees` too far round."""
    turn = (2 * math.pi + math.radians(degrees)) / (poses - 1)
    yield Draft().se2("x0", (0, 0, 0), fixed=True).batch()
    for n in range(1, poses):
        draft = Draft().se2(f"x{n}")
        yield draft.between_se2(f"x{n - 1}", f"x{n}", (1, 0, turn), sigmas=(0.05, 0.05, 0.03)).batch()


def closing(poses: int) -> Batch:
    """The last pose is where the first one is."""
    return Draft().between_se2(f"x{poses - 1}", "x0", (0, 0, 0), sigmas=(0.1, 0.1, 0.05)).batch()


def optimum(poses: int, degrees: float) -> float:
    """χ² of it all at its optimum."""

    solver = Solver(Options(mode="all-batch"))
    for batch in (*drive(poses, degrees), closing(poses)):
        solver.stage(batch)
    return solver.step(settle=True).chi2
