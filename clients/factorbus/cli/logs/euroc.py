"""EuRoC folders: a `mav0` with a folder a sensor, each a data.csv and maybe a sensor.yaml.

    imu0                          time, gyroscopes, accelerometers
    gps0                          time, latitude, longitude, height, and maybe sigmas east, north, up (metres)
    odom0                         time, position, qw qx qy qz: a trajectory in a frame of its own, visual odometry
    vicon0                        the same: where the robot is, in the frame of the room
    state_groundtruth_estimate0   the same, and more: to be held against, nothing of it is used

gps0 and odom0 are no folders of EuRoC's own: they are what a receiver and a visual odometry may add.  T_BS of a
sensor.yaml says where the sensor is on the body; with `sigma_T_BS` (x y z in metres, three angles in radians) it is
so uncertain, and found out.  `origin` of gps0 (latitude, longitude, height) is where east, north and up begin; without
that is the first fix.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from factorbus.cli.logs.sensor_log import NO_TURN, Fixes, Imu, SensorLog, Way
from factorbus.cli.logs.table import sensor_settings, timed
from factorbus.client.geodetic import MOST_LONGITUDE, enu
from factorbus.client.imu import ImuNoise
from factorbus.formats import FormatError
from factorbus.proto.arrays import F64, I64
from factorbus.wording import counted

_NOISE = {
    "gyroscope": ("gyroscope_noise_density", 1.6968e-4),
    "accelerometer": ("accelerometer_noise_density", 2.0e-3),
    "gyroscope_walk": ("gyroscope_random_walk", 1.9393e-5),
    "accelerometer_walk": ("accelerometer_random_walk", 3.0e-3),
}
_VICON, _ODOMETRY = (0.01, 0.02), (0.02, 0.01)  # metres, radians
_GNSS = (1.0, 1.0, 2.0)


def read_euroc(folder: Path) -> SensorLog:
    """The log in a folder that has imu0.  Raises FormatError."""
    times, rates = timed(folder / "imu0" / "data.csv", 6, "gyroscopes, accelerometers")
    told, notes = (
        sensor_settings(folder / "imu0" / "sensor.yaml", {"T_BS", *(name for name, _ in _NOISE.values())}),
        [f"EuRoC: {counted(len(times), 'sample')} of {folder / 'imu0'}"],
    )
    if "T_BS" in told and not np.array_equal(told["T_BS"], np.eye(4).ravel()):
        wanted = "that of no motion: poses are those of the IMU, so T_BS of other sensors has to be from it"
        raise FormatError(str(folder / "imu0" / "sensor.yaml"), None, f"T_BS {told['T_BS'].tolist()}", wanted)
    missing = [name for name, _ in _NOISE.values() if name not in told]
    densities = {mine: told.get(name, np.array([usual])) for mine, (name, usual) in _NOISE.items()}
    for mine, density in densities.items():
        if density.size != 1 or not density[0] > 0:
            file = folder / "imu0" / "sensor.yaml"
            raise FormatError(str(file), None, f"{_NOISE[mine][0]} {density.tolist()}", "a number above 0")
    noise = ImuNoise(**{mine: float(density[0]) for mine, density in densities.items()})
    if missing:
        notes.append(f"assumed: {', '.join(missing)} as of EuRoC's ADIS16448, for sensor.yaml does not say")
    fixes, way = _fixes(folder / "gps0", notes), _way(folder / "odom0", True, _ODOMETRY, notes)
    way = way or _way(folder / "vicon0", False, _VICON, notes)
    if fixes is None and way is None:
        has = ", ".join(sorted(each.name for each in folder.iterdir() if each.is_dir()))
        wanted = "gps0, odom0 or vicon0 beside it: an IMU alone drifts away"
        raise FormatError(str(folder), None, f"no sensor that tells where the robot is (there is {has})", wanted)
    truth = folder / "state_groundtruth_estimate0" / "data.csv"
    known = _poses(truth, *timed(truth, 7, "position, qw qx qy qz")) if truth.exists() else None
    if known:
        notes.append(f"{counted(len(known[0]), 'pose')} of {truth.parent}, to be held against; nothing of them is used")
    return SensorLog(str(folder), "euroc", Imu(times, rates, noise), fixes, way, known, notes=tuple(notes))


def _fixes(folder: Path, notes: list[str]) -> Fixes | None:
    file = folder / "data.csv"
    if not file.exists():
        return None
    with file.open(encoding="utf-8", errors="replace") as lines:
        first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    has_sigmas = first.count(",") >= 6
    what = "latitude, longitude, height" + (", sigmas east, north, up" if has_sigmas else "")
    times, rows = timed(file, 6 if has_sigmas else 3, what)
    off = (np.abs(rows[:, :2]) > [90.0, MOST_LONGITUDE]).any(axis=1)
    wrong = np.flatnonzero(off | (rows[:, 3:] <= 0).any(axis=1))
    if wrong.size:
        latitude, longitude, _, *sigmas = rows[wrong[0]].tolist()
        found = f"the {wrong[0] + 1}. fix: latitude {latitude:g}, longitude {longitude:g}, sigmas {sigmas}"
        wanted = f"latitudes of -90 to 90 and longitudes of -{MOST_LONGITUDE:g} to {MOST_LONGITUDE:g} degrees"
        raise FormatError(str(file), None, found, f"{wanted}, and sigmas above 0")
    origin = sensor_settings(folder / "sensor.yaml", {"origin"}).get("origin", rows[0, :3])
    if origin.size != 3 or (np.abs(origin[:2]) > [90.0, MOST_LONGITUDE]).any():
        found = f"origin {origin.tolist()}"
        raise FormatError(str(folder / "sensor.yaml"), None, found, "latitude, longitude (degrees), height (metres)")
    places = np.array([enu(row[:3], origin) for row in rows])
    sigmas = rows[:, 3:6] if has_sigmas else np.tile(_GNSS, (len(rows), 1))
    mount, sigma = _mount(folder, notes)
    frame = ", ".join(f"{number:.7g}" for number in origin.tolist())
    assumed = "" if has_sigmas else f"; assumed: sigmas {_GNSS} m"
    notes.append(f"{counted(len(rows), 'fix', 'fixes')} of {folder}, east, north, up of {frame}{assumed}")
    return Fixes(times, places, sigmas, mount[:3], None if sigma is None else sigma[:3])


def _way(folder: Path, relative: bool, usual: tuple[float, float], notes: list[str]) -> Way | None:
    file = folder / "data.csv"
    if not file.exists():
        return None
    times, poses = _poses(file, *timed(file, 7, "position, qw qx qy qz"))
    told = sensor_settings(folder / "sensor.yaml", {"sigma_position", "sigma_angle"})
    given = [told.get(f"sigma_{name}", np.array([s])) for name, s in zip(("position", "angle"), usual, strict=True)]
    if any(each.size != 1 or not each[0] > 0 for each in given):
        found = f"sigma_position {given[0].tolist()}, sigma_angle {given[1].tolist()}"
        raise FormatError(str(folder / "sensor.yaml"), None, found, "a number above 0 for each: metres, radians")
    sigmas = [float(each[0]) for each in given]
    each = "from one to the next" if relative else "each"
    said = "as in sensor.yaml" if "sigma_position" in told else "assumed"
    notes.append(
        f"{counted(len(times), 'pose')} of {folder}, {each} {sigmas[0]} m and {sigmas[1]} rad certain ({said})"
    )
    mount, sigma = _mount(folder, notes)
    return Way(times, poses, np.repeat(sigmas, 3), mount, relative, sigma)


def _mount(folder: Path, notes: list[str]) -> tuple[F64, F64 | None]:
    """(where the sensor is on the body (7,), how certain that is (6,) or None).  Raises FormatError."""
    file = folder / "sensor.yaml"
    told: Mapping[str, F64] = sensor_settings(file, {"T_BS", "sigma_T_BS"})
    matrix, sigma = told.get("T_BS"), told.get("sigma_T_BS")
    if matrix is None:
        notes.append(f"assumed: {folder.name} is in the middle of the body, for no sensor.yaml has a T_BS")
        return NO_TURN, sigma
    if matrix.size != 16 or abs(np.linalg.det(matrix.reshape(4, 4)) - 1) > 1e-3:
        raise FormatError(
            str(file), None, f"T_BS of {counted(matrix.size, 'number')}", "16 numbers of a rigid motion, row by row"
        )
    if sigma is not None and (sigma.size != 6 or (sigma <= 0).any()):
        raise FormatError(str(file), None, f"sigma_T_BS {sigma.tolist()}", "six numbers above 0: metres, radians")
    return _pose(matrix.reshape(4, 4)), sigma


def _poses(file: Path, times: I64, rows: F64) -> tuple[I64, F64]:
    """EuRoC has qw first."""
    lengths = np.linalg.norm(rows[:, 3:7], axis=1)
    wrong = np.flatnonzero(np.abs(lengths - 1) > 1e-2)
    if wrong.size:
        raise FormatError(
            str(file), None, f"the {wrong[0] + 1}. quaternion has length {lengths[wrong[0]]:g}", "length 1"
        )
    return times, np.column_stack([rows[:, :3], rows[:, 4:7] / lengths[:, None], rows[:, 3] / lengths])


def _pose(T: F64) -> F64:
    """x y z qx qy qz qw of a matrix (4, 4)."""
    R = T[:3, :3]
    # The quaternion is the eigenvector of the largest eigenvalue of this symmetric matrix (Bar-Itzhack 2000).
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    quat = np.linalg.eigh(K)[1][:, -1]
    return np.concatenate([T[:3, 3], quat * (1.0 if quat[3] >= 0 else -1.0)])
