"""KITTI's logs: the raw data's `oxts` folder, and the two text files that ship with GTSAM.

oxts/timestamps.txt, oxts/data/*.txt   30 numbers a packet: latitude, longitude, altitude, ... ax ay az, wx wy wz
KittiEquivBiasedImu.txt                Time dt accelX accelY accelZ omegaX omegaY omegaZ, and _metadata.txt
KittiGps_converted.txt                 Time,X,Y,Z
"""

from pathlib import Path

import numpy as np

from factorbus.cli.logs.sensor_log import Fixes, Imu, SensorLog
from factorbus.cli.logs.table import in_order, rows_of_numbers, stamp_of_date, text_of
from factorbus.client.geodetic import MOST_LONGITUDE, enu
from factorbus.client.imu import ImuNoise
from factorbus.formats import FormatError
from factorbus.proto.arrays import I64

IMU, GPS = "KittiEquivBiasedImu.txt", "KittiGps_converted.txt"
OXTS = "oxts"
_ACCELERATION, _TURN, _ACCURACY = slice(11, 14), slice(17, 20), 23
_PACKET = "latitude, longitude, altitude and 22 more numbers of a KITTI packet"
# Of the OXTS RT 3003 as its data sheet has it.
_OXTS = ImuNoise(gyroscope=6e-5, accelerometer=1e-3, gyroscope_walk=1e-5, accelerometer_walk=1e-3)
_GPS_SIGMA = 0.07


def read_oxts(folder: Path) -> SensorLog:
    """KITTI raw.  Raises FormatError."""
    stamps, files = folder / "timestamps.txt", sorted((folder / "data").glob("*.txt"))
    lines = [(n, row) for n, row in enumerate(text_of(stamps, "a time a line").splitlines(), 1) if row.strip()]
    times = np.array([stamp_of_date(stamps, n, row) for n, row in lines], np.int64)
    in_order(stamps, times, np.array([n for n, _ in lines], np.int64))
    if len(files) != len(times) or not files:
        found = f"{len(files)} packets in {folder / 'data'} for {len(times)} times"
        raise FormatError(str(stamps), None, found, "a packet a time, and at least one")
    packets = np.array([rows_of_numbers(file, _ACCURACY + 1, _PACKET, None)[0][0] for file in files])
    wrong = np.flatnonzero((np.abs(packets[:, :2]) > [90.0, MOST_LONGITUDE]).any(axis=1))
    if wrong.size:
        found = "latitude {:g}, longitude {:g}".format(*packets[wrong[0], :2])
        wanted = f"-90 to 90 degrees, and -{MOST_LONGITUDE:g} to {MOST_LONGITUDE:g}"
        raise FormatError(str(files[wrong[0]]), 1, found, wanted)
    places = np.array([enu(row[:3], packets[0, :3]) for row in packets])
    sigmas = np.maximum(packets[:, _ACCURACY, None], 0.01) * [1.0, 1.0, 2.0]
    rates = np.column_stack([packets[:, _TURN], packets[:, _ACCELERATION]])
    rate = _hz(times)
    noise = _OXTS if rate > 50 else ImuNoise(1e-3, 0.1, 1e-5, 1e-3, integration=0.05)
    return SensorLog(
        str(folder), "kitti raw", Imu(times, rates, noise), Fixes(times, places, sigmas, np.zeros(3)), every_s=1.0,
        notes=(
            f"KITTI raw: {len(files)} packets of {folder / 'data'}, {rate:.0f} a second: IMU and latitude, longitude, "
            "altitude of each",
            "assumed: the map is east, north, up of the first packet; positions are as certain as pos_accuracy, height "
            "half as certain; their errors do not depend on each other, which those of KITTI's own filter do; noise of "
            "the IMU as its data sheet has it" + ("" if rate > 50 else ", and more, of so few samples a second"),
        ),
    )  # fmt: skip


def read_gtsam_kitti(folder: Path) -> SensorLog:
    """The two files that ship with GTSAM.  Raises FormatError."""
    imu_file, gps_file = folder / IMU, folder / GPS
    imu, imu_lines = rows_of_numbers(imu_file, 8, "Time dt accelX accelY accelZ omegaX omegaY omegaZ", None, header=1)
    gps, gps_lines = rows_of_numbers(gps_file, 4, "Time,X,Y,Z", ",", header=1)
    times, at = (np.round(table[:, 0] * 1e9).astype(np.int64) for table in (imu, gps))
    in_order(imu_file, times, imu_lines)
    in_order(gps_file, at, gps_lines)
    noise, where = _metadata(folder / "KittiEquivBiasedImu_metadata.txt")
    return SensorLog(
        str(folder), "kitti of gtsam", Imu(times, np.column_stack([imu[:, 5:8], imu[:, 2:5]]), noise),
        Fixes(at, gps[:, 1:4], np.full((len(gps), 3), _GPS_SIGMA), np.zeros(3)), every_s=0.9,
        gravity=np.array([0, 0, -9.8]),
        notes=(
            f"KITTI of GTSAM: {len(imu)} samples of {imu_file}, {len(gps)} positions of {gps_file}",
            f"assumed: noise of the IMU {where}; positions are {_GPS_SIGMA} m certain, of the IMU itself, and gravity "
            "is 9.8 m/s², as GTSAM's example has it",
        ),
    )  # fmt: skip


def _metadata(path: Path) -> tuple[ImuNoise, str]:
    """(noise, where it is from); its sigmas of biases are of samples.  Raises FormatError."""
    if not path.exists():
        return ImuNoise(1.75e-4, 0.01, 2.9e-5, 1.67e-3), "as in GTSAM's example: there is no metadata"
    (row, *_), (line, *_) = rows_of_numbers(path, 12, "twelve numbers of the IMU", None, header=1)
    accelerometer, gyroscope, integration, accelerometer_walk, gyroscope_walk, step = row[6:12]
    if not (row[6:8] > 0).all() or not (row[9:12] > 0).all() or integration < 0:
        raise FormatError(str(path), int(line), f"sigmas {row[6:12].tolist()}", "sigmas and a step above 0")
    return ImuNoise(
        gyroscope, accelerometer, gyroscope_walk / step**0.5, accelerometer_walk / step**0.5, integration
    ), f"as in {path.name}"


def _hz(times: I64) -> float:
    return 1e9 / float(np.median(np.diff(times))) if len(times) > 1 else 0.0
