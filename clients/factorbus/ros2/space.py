"""The plane and space: which kinds of variables and factors, and which of the six axes count."""

from dataclasses import dataclass

import numpy as np

from factorbus.proto.arrays import F64
from factorbus.ros2.certainty import floored
from factorbus.ros2.geometry import Transform, from_plane, from_quaternion, quaternion


@dataclass(frozen=True, slots=True)
class BridgeSpace:
    """axes: of x y z and the three rotations.  scale: from the tangent space to a pose's residual, axis by axis."""

    pose: str
    point: str
    axes: tuple[int, ...]
    scale: F64

    @property
    def flat(self) -> bool:
        """In the plane."""
        return self.pose == "se2"

    @property
    def point_axes(self) -> tuple[int, ...]:
        """Which of x y z a point has."""
        return (0, 1) if self.flat else (0, 1, 2)

    def fitted(self, T: Transform) -> Transform:
        """What of a transform counts."""
        return T.flat() if self.flat else T

    def row(self, T: Transform) -> list[float]:
        """As the map stores a pose."""
        return [T.t[0], T.t[1], T.yaw()] if self.flat else [*T.t.tolist(), *quaternion(T.R)]

    def transform(self, row: F64) -> Transform:
        """From what the map stores."""
        return from_plane(*row.tolist()) if self.flat else from_quaternion(row[:3].tolist(), row[3:].tolist())

    def residual(self, covariance: F64) -> F64:
        """Of a 6 × 6 covariance what counts, as the covariance of a pose's residual."""
        return covariance[np.ix_(self.axes, self.axes)] * np.outer(self.scale, self.scale)

    def floored(self, covariance: F64, metres: float, radians: float) -> F64:
        """A 6 × 6 covariance nowhere more certain than that in the axes that count; zero in the others."""
        floor = np.array([metres] * 3 + [radians] * 3)[list(self.axes)]
        made = np.zeros((6, 6))
        made[np.ix_(self.axes, self.axes)] = floored(covariance[np.ix_(self.axes, self.axes)], floor)
        return made


# The rotation part of an se3 residual is the vector part of a quaternion: half an angle.
SPACES = {
    "plane": BridgeSpace("se2", "point2", (0, 1, 5), np.ones(3)),
    "space": BridgeSpace("se3", "point3", (0, 1, 2, 3, 4, 5), np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])),
}
