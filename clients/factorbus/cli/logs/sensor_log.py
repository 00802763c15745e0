"""What a log of sensors has, whatever files it came from.

Times are nanoseconds, int64.  The body is what the IMU is fixed to: its frame is that of the poses.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from factorbus.client.imu import STANDARD_GRAVITY, ImuNoise
from factorbus.proto.arrays import F64, I64

if TYPE_CHECKING:
    from factorbus.cli.logs.log_steps import LogSteps
    from factorbus.formats import RobotLog

NO_TURN = np.array([0, 0, 0, 0, 0, 0, 1.0])
LEVEL = np.array([0.0, 0.0, -STANDARD_GRAVITY])


@dataclass(frozen=True, slots=True)
class Imu:
    """times (m,), increasing; rates (m, 6): gyroscopes rad/s, accelerometers m/s²."""

    times: I64
    rates: F64
    noise: ImuNoise


@dataclass(frozen=True, slots=True)
class Fixes:
    """Positions of an antenna, GNSS: metres east, north and up (k, 3), with standard deviations (k, 3).

    lever (3,): where the antenna is on the body; sigma_lever: how well that is known, None for exactly.
    """

    times: I64
    places: F64
    sigmas: F64
    lever: F64
    sigma_lever: F64 | None = None


@dataclass(frozen=True, slots=True)
class Way:
    """Poses (k, 7) of a sensor in a frame of its own.

    relative: only from one to the next they are right, as of odometry, with sigmas (6,) of that; otherwise each is a
    measurement of where the sensor is in the map.  mount (7,), sigma_mount (6,) or None: as of the lever of `Fixes`.
    """

    times: I64
    poses: F64
    sigmas: F64
    mount: F64
    relative: bool = True
    sigma_mount: F64 | None = None


@dataclass(frozen=True, slots=True)
class SensorLog:
    """A log; truth: times and poses of the body, of which nothing is used but to be held against.

    notes: which files were read and what was assumed, for people.
    """

    path: str
    dialect: str
    imu: Imu
    fixes: Fixes | None = None
    way: Way | None = None
    truth: tuple[I64, F64] | None = None
    gravity: F64 = field(default_factory=lambda: LEVEL.copy())
    notes: tuple[str, ...] = ()
    every_s: float = 0.5

    numbering = "keys"
    left_out: tuple[()] = ()

    @property
    def log(self) -> "RobotLog | None":
        """Ground truth by the keys of the poses that it has one at."""
        from factorbus.formats import RobotLog

        truth = self.steps().truth()
        return RobotLog(self.path, (), truth) if truth else None

    def steps(self, use_values: bool = False) -> "LogSteps":
        """An insert for each pose, in order of time; a log has no values to use.  Raises FormatError."""
        from factorbus.cli.logs.log_steps import LogSteps

        return LogSteps(self)

    def summary(self) -> dict[str, object]:
        """A program's summary of how the log was read."""
        return {"dialect": self.dialect, "notes": list(self.notes), "left_out": {}}
