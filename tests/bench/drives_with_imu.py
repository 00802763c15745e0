"""Logs of an IMU and GNSS that ship in the gtsam wheel, as drives of a pose for each GNSS measurement."""

from dataclasses import dataclass

import gtsam
import numpy as np

from factorbus.client import ImuNoise

DRIVES = ("kitti", "imu_gps")


@dataclass(frozen=True, slots=True)
class Drive:
    """What is known of it, SI units.

    samples: of each step but the first (n, 7), duration, gyroscopes, accelerometers.  positions (steps, 3), used
    (steps,): whether a position is a factor.  attitude (4,), velocity (3,): what it begins with.
    sigma_position: metres.  sigmas_pose: of the first pose, metres and radians; sigmas_velocity (3,), sigmas_bias (6,):
    gyroscopes, accelerometers.
    """

    name: str
    noise: ImuNoise
    gravity: np.ndarray
    samples: list[np.ndarray]
    positions: np.ndarray
    used: np.ndarray
    attitude: np.ndarray
    velocity: np.ndarray
    sigma_position: float
    sigmas_pose: np.ndarray
    sigmas_velocity: np.ndarray
    sigmas_bias: np.ndarray

    @property
    def steps(self) -> int:
        """Poses."""
        return len(self.positions)


def drive_of(name: str, steps: int | None = None) -> Drive:
    """A drive by its name, or its first steps."""
    return {"kitti": _kitti, "imu_gps": _imu_gps}[name](steps)


def _kitti(steps: int | None) -> Drive:
    """As GTSAM's IMUKittiExampleGPS has it: position factors are of every tenth measurement."""
    imu = np.loadtxt(gtsam.findExampleDataFile("KittiEquivBiasedImu.txt"), skiprows=1)
    gps = np.loadtxt(gtsam.findExampleDataFile("KittiGps_converted.txt"), delimiter=",", skiprows=1)[1:]
    gps = gps[: steps and steps + 1]
    times, samples = imu[:, 0], []
    for before, here in zip(gps[:-1, 0], gps[1:, 0], strict=True):
        rows = imu[(times >= before) & (times < here)]
        samples.append(np.column_stack([rows[:, 1], rows[:, 5:8], rows[:, 2:5]]))
    rate = 0.0100395199348279  # seconds a sample: the file's sigmas are of samples
    noise = ImuNoise(1.75e-4, 0.01, 2.91e-6 / np.sqrt(rate), 1.67e-4 / np.sqrt(rate))
    ahead = gps[1, 1:] - gps[0, 1:]
    yaw = np.arctan2(ahead[1], ahead[0])
    return Drive(
        "kitti", noise, np.array([0, 0, -9.8]), samples, gps[:, 1:], np.arange(len(gps)) % 10 == 0,
        np.array([0, 0, np.sin(yaw / 2), np.cos(yaw / 2)]), ahead / (gps[1, 0] - gps[0, 0]), 0.07,
        np.array([1.0] * 3 + [0.1] * 3), np.array([1.0] * 3), np.array([5e-5] * 3 + [0.1] * 3),
    )  # fmt: skip


def _imu_gps(steps: int | None) -> Drive:
    """As GTSAM's ImuFactorsExample has it, in which gravity is zero, and the samples know of none."""
    path = gtsam.findExampleDataFile("imuAndGPSdata.csv")
    with open(path) as file:
        rows = [[float(cell) for cell in line.split(",")[1:]] for line in file if line[0] != "i"]
    samples, positions, since = [], list[np.ndarray](), []
    for row in rows:
        if len(row) == 6:
            since.append([0.005, *row[3:], *row[:3]])
            continue
        if positions:
            samples.append(np.array(since))
        positions.append(np.array(row[:3]))
        since = []
    count = min(steps or len(samples), len(samples))
    noise = ImuNoise(0.000205689024915, 0.0003924, 0.000001454441043, 0.004905, 1e-4)
    return Drive(
        "imu_gps", noise, np.zeros(3), samples[:count], np.array(positions[: count + 1]),
        np.arange(count + 1) > 0, np.array([0, 0, 0, 1.0]), np.zeros(3), 1.0,
        np.array([0.5] * 3 + [0.01] * 3), np.array([0.1] * 3), np.array([1e-3] * 6),
    )  # fmt: skip
