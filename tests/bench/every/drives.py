"""What is replayed, by name: a world is a function of a number of poses and a seed that gives batches."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from bench.replays.own_kinds import in_own_kinds, with_values
from bench.replays.problems import Problem, load

from factorbus.datasets import CATALOGUE, Places, dataset_named, locate
from factorbus.proto.messages import Batch
from factorbus.simulate import WORLDS as SIMULATED
from factorbus.simulate import TreeSensor

from . import far, hard, late
from .motion import PLANE, SPACE

Make = Callable[[int, int], Iterable[Batch]]  # poses (0: all), seed


@dataclass(frozen=True, slots=True)
class World:
    """A name, what makes its steps, and how many poses it has; 0: all that there are.

    kind: "simulated" and "data" are ordinary drives, for which there are more targets; "hard" are not.
    data: the data set that it is made of
    """

    name: str
    make: Make
    poses: int = 1000
    kind: str = "simulated"
    data: str = ""

    @property
    def is_drawn(self) -> bool:
        """Another one for every seed."""
        return self.kind != "data"

    @property
    def is_ordinary(self) -> bool:
        """No step of it turns much of the map."""
        return self.kind != "hard"


def _simulated(name: str, poses: int, seed: int, **more: Any) -> Iterator[Batch]:
    return (step.batch for step in SIMULATED[name](poses, seed, **more))


def _data(name: str, poses: int, _seed: int) -> Iterable[Batch]:
    return load(Problem(name, name, poses))


def _own(make: Make, poses: int, seed: int) -> Iterator[Batch]:
    """The same measurements as kinds that a client has written as formulas."""
    return map(in_own_kinds, with_values(make(poses, seed)))


KINDS = ("simulated", "data", "hard")
WORLDS = {
    world.name: world
    for world in (
        World("manhattan", partial(_simulated, "manhattan")),
        World("city_trees", partial(_simulated, "city_trees")),
        World("sphere", partial(_simulated, "sphere")),
        World("bearing_range", partial(_simulated, "city_trees", sensor=TreeSensor("bearing_range_se2"))),
        World("own_manhattan", partial(_own, partial(_simulated, "manhattan"))),
        World("own_city_trees", partial(_own, partial(_simulated, "city_trees"))),
        World("own_sphere", partial(_own, partial(_simulated, "sphere"))),
        World("outliers", hard.outliers, kind="hard"),
        World("drift", hard.drift, kind="hard"),
        World("meetings_2d", partial(hard.meetings, PLANE), 400, "hard"),
        World("meetings_3d", partial(hard.meetings, SPACE), 400, "hard"),
        World("late_2d", partial(hard.late_positions, PLANE), 300, "hard"),
        World("late_3d", partial(hard.late_positions, SPACE), 300, "hard"),
        World("ranges_2d", partial(late.late_ranges, PLANE), 300, "hard"),
        World("ranges_3d", partial(late.late_ranges, SPACE), 300, "hard"),
        World("frames_2d", partial(late.late_frames, PLANE), 300, "hard"),
        World("frames_3d", partial(late.late_frames, SPACE), 300, "hard"),
        World("far_2d", partial(far.far_landmarks, PLANE), 200, "hard"),
        World("far_3d", partial(far.far_landmarks, SPACE), 200, "hard"),
        World("own_far_2d", partial(_own, partial(far.far_landmarks, PLANE)), 200, "hard"),
        *(
            World(name, partial(_data, name), 0, "data", name)
            for name in ("intel", "killian_freiburg", "manhattan3500", "victoria_park", "parking_garage", "sphere2500")
        ),
        World("own_parking_garage", partial(_own, partial(_data, "parking_garage")), 0, "data", "parking_garage"),
    )
}


def chosen(words: list[str]) -> list[World]:
    """The worlds of these names or kinds, all where there are none.  Raises ValueError for an unknown one."""
    if unknown := [word for word in words if word not in (*WORLDS, *KINDS)]:
        raise ValueError(f"{', '.join(unknown)}: none of {', '.join((*KINDS, *WORLDS))}")
    return [world for world in WORLDS.values() if not words or world.name in words or world.kind in words]


def is_here(world: World) -> bool:
    """Whether the data set of a world is on this machine."""
    return world.is_drawn or locate(dataset_named(world.data, CATALOGUE), Places.of_this_machine()) is not None
