"""Simulated worlds with known truth: streams of steps, from the same seed always the same, of any length.

Each world is a function of (poses, seed, ...) and gives a `Step` a pose.  A longer run begins with the shorter one.
`monocular` is one for filters and cameras: it gives a `Frame` an image.  `inertial` has an IMU, GNSS and a camera's
odometry, and gives an `InertialWorld`.
"""

from collections.abc import Callable, Iterator, Mapping

from factorbus.simulate.city_trees import TreeSensor, city_trees
from factorbus.simulate.inertial import InertialWorld, SensorErrors, inertial
from factorbus.simulate.manhattan import LoopClosures, manhattan
from factorbus.simulate.monocular import Frame, MonocularWorld, monocular
from factorbus.simulate.parameters import BadParameter
from factorbus.simulate.sphere import Spiral, sphere
from factorbus.simulate.step import Step

WORLDS: Mapping[str, Callable[..., Iterator[Step]]] = {
    "manhattan": manhattan,
    "city_trees": city_trees,
    "sphere": sphere,
}

__all__ = [
    "WORLDS",
    "BadParameter",
    "Frame",
    "InertialWorld",
    "LoopClosures",
    "MonocularWorld",
    "SensorErrors",
    "Spiral",
    "Step",
    "TreeSensor",
    "city_trees",
    "inertial",
    "manhattan",
    "monocular",
    "sphere",
]
