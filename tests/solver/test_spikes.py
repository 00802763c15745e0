"""χ² along a drive: Inc-L stays at the optimum, with forced batches it leaves it in between (2013 paper, Fig. 5)."""

import numpy as np
import pytest

from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS
from factorbus.solver import Options, Solver

POSES = 350


@pytest.mark.parametrize(("world", "seed"), [("manhattan", 1), ("manhattan", 2), ("city_trees", 1)])
def test_chi2_has_spikes_between_forced_batches_and_none_without(world: str, seed: int) -> None:
    steps = [step.batch for step in WORLDS[world](POSES, seed)]
    optimum = chi2_along(steps, "all-batch")
    counted = optimum > 1.0
    assert counted.sum() > POSES / 2
    worst = {
        mode: float((chi2_along(steps, mode)[counted] / optimum[counted]).max())
        for mode in ("inc-l", "inc-l-b10", "inc-l-b100")
    }
    print(world, seed, worst)
    assert worst["inc-l"] < 1.001
    assert worst["inc-l-b10"] > 1.02
    assert worst["inc-l-b100"] > 1.02


def chi2_along(steps: list[Batch], mode: str) -> np.ndarray:
    """χ² after every step."""
    solver, chi2 = Solver(Options(mode=mode)), []
    for batch in steps:
        solver.stage(batch)
        chi2.append(solver.step().chi2)
    return np.array(chi2)
