"""What is replayed, by name: a world is a function of a number of poses and a seed that gives batches."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial

from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS as SIMULATED

from . import hard
from .motion import PLANE, SPACE

Make = Callable[[int, int], Iterable[Batch]]  # poses, seed


@dataclass(frozen=True, slots=True)
class World:
    """A name, what makes it, how many poses it has, and whether its drives are ordinary ones: those have more targets."""

    name: str
    make: Make
    poses: int = 1000
    ordinary: bool = True


def _simulated(name: str, poses: int, seed: int, **more: object) -> Iterable[Batch]:
    return (step.batch for step in SIMULATED[name](poses, seed, **more))


WORLDS = {
    world.name: world
    for world in (
        World("manhattan", partial(_simulated, "manhattan")),
        World("city_trees", partial(_simulated, "city_trees")),
        World("sphere", partial(_simulated, "sphere")),
        World("bearing_range", partial(_simulated, "city_trees", sensor="bearing_range_se2")),
        World("outliers", hard.outliers, ordinary=False),
        World("drift", hard.drift, ordinary=False),
        World("meetings_2d", partial(hard.meetings, PLANE), 400, ordinary=False),
        World("meetings_3d", partial(hard.meetings, SPACE), 400, ordinary=False),
        World("late_2d", partial(hard.late_positions, PLANE), 300, ordinary=False),
        World("late_3d", partial(hard.late_positions, SPACE), 300, ordinary=False),
    )
}
