"""Which log a path is of, by the names of its files."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from factorbus.cli.logs.euroc import read_euroc
from factorbus.cli.logs.kitti import GPS, IMU, OXTS, read_gtsam_kitti, read_oxts
from factorbus.cli.logs.sensor_log import SensorLog
from factorbus.formats import FormatError, is_glim


def is_log(path: Path) -> bool:
    """Whether it is a folder, of no graph, or one of the two files of GTSAM's KITTI drive."""
    return (path.is_dir() and not is_glim(path)) or (path.name in (IMU, GPS) and path.exists())


def read_log(path: Path) -> SensorLog:
    """The log in a folder, and in its notes what was assumed.  Raises FormatError."""
    log = _read(path)
    return replace(log, notes=(*log.notes, *log.steps().notes))


def has_log(path: Path) -> bool:
    """Whether a log that is known is in this folder, or beside this file of GTSAM's KITTI drive."""
    return is_log(path) and _reader(path) is not None


def _read(path: Path) -> SensorLog:
    if (reader := _reader(path)) is not None:
        return reader()
    wanted = (
        f"EuRoC's mav0/imu0, KITTI's {OXTS}/timestamps.txt and {OXTS}/data, {IMU} and {GPS}, a rosbag2 folder, or the "
        "graph.txt and submaps of a map that GLIM has saved"
    )
    raise FormatError(str(path), None, "a folder without a log or a recording that is known", wanted)


def _reader(path: Path) -> Callable[[], SensorLog] | None:
    """What reads the log; None where there is none that is known."""
    folder = path if path.is_dir() else path.parent
    for each in (folder, folder / "mav0"):
        if (each / "imu0").is_dir():
            return partial(read_euroc, each)
    for each in (folder, folder / OXTS):
        if (each / "timestamps.txt").exists() and (each / "data").is_dir():
            return partial(read_oxts, each)
    if (folder / IMU).exists() or (folder / GPS).exists():
        return partial(read_gtsam_kitti, folder)
    return None
