"""The pose that a robot steers by is where its odometry wants it, at every step of whole drives.  MATH §9.6

A loop moves the newest pose, and the odometry that comes next is linearized there: it was off by 2 to 41 standard
deviations on these drives until the map was looked at again.  A step with nothing but odometry fits exactly.
"""

import math
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from naive.dense_factors import residual

from factorbus.formats import read
from factorbus.proto.messages import Batch
from factorbus.simulate import manhattan
from factorbus.solver import Options, Solver

# Nobody looks at what linearization has missed: so it was but at every sixteenth step.
BLIND = Options.of(
    relinearize_next_step_share=1e9,
    relinearize_same_step_share=1e9,
    relinearize_max_error=math.inf,
    converged_share=1e9,
)


def worst_odometry(steps: Iterable[Batch], options: Options | None = None) -> float:
    """The largest √(rᵀΩr) of a new relative pose that came by itself, at the estimate after its step."""
    return max(odometry_lengths(steps, Solver(options or Options())))


def odometry_lengths(steps: Iterable[Batch], solver: Solver) -> Iterator[float]:
    values = dict[int, np.ndarray]()
    for batch in steps:
        solver.stage(batch)
        solver.step()
        for group in (*batch.variables, *solver.changed()):
            if group.values is not None:
                values.update(zip(group.keys.tolist(), group.values, strict=True))
        if batch.factor_count == 1 and batch.factors[0].keys.shape[1] == 2:
            (group,) = batch.factors
            r = residual(group.kind, [values[key] for key in group.keys[0].tolist()], group.measured[0])
            upper = np.zeros((r.size, r.size))
            upper[np.triu_indices(r.size)] = group.information[0]
            yield math.sqrt(r @ (upper + np.triu(upper, 1).T) @ r)


@pytest.mark.parametrize("seed", [1, 2, 3])  # 4.5, 8.3 and 20
def test_on_a_street_grid(seed: int) -> None:
    assert worst_odometry(step.batch for step in manhattan(2000, seed)) < 0.25


def test_it_is_the_look_that_makes_it_so() -> None:
    assert worst_odometry((step.batch for step in manhattan(2000, 3)), BLIND) > 20.0


def test_on_one_with_four_times_the_noise() -> None:  # 41
    drive = manhattan(2000, 3, sigma_xy_m=0.09, sigma_theta_rad=0.09)
    assert worst_odometry(step.batch for step in drive) < 0.5


@pytest.mark.data
@pytest.mark.parametrize(("name", "poses"), [("manhattan3500", 3500), ("city10000", 4000)])  # 1.8 and 3.4
def test_on_data_sets(datasets: Path, name: str, poses: int) -> None:
    assert worst_odometry(islice(read(datasets / f"{name}.g2o").steps(), poses)) < 0.25
