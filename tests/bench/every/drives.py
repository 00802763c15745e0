"""What is replayed, by name: a world is a function of a seed and a number of poses that gives steps."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS as SIMULATED

from . import hard

Make = Callable[[int, int], Iterator[Batch]]  # poses, seed


@dataclass(frozen=True, slots=True)
class World:
    """A name, what makes it, how many poses it has, and whether its drives are ordinary ones: those have more targets."""

    name: str
    make: Make
    poses: int = 1000
    ordinary: bool = True


def _simulated(name: str, **more: object) -> Make:
    return lambda poses, seed: (step.batch for step in SIMULATED[name](poses, seed, **more))


WORLDS = {
    world.name: world
    for world in (
        World("manhattan", _simulated("manhattan")),
        World("city_trees", _simulated("city_trees")),
        World("sphere", _simulated("sphere")),
        World("drift", hard.drift, ordinary=False),
    )
}
