"""Which log a path is of, by the names of its files."""

from dataclasses import replace
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


def _read(path: Path) -> SensorLog:
    folder = path if path.is_dir() else path.parent
    for each in (folder, folder / "mav0"):
        if (each / "imu0").is_dir():
            return read_euroc(each)
    for each in (folder, folder / OXTS):
        if (each / "timestamps.txt").exists() and (each / "data").is_dir():
            return read_oxts(each)
    if (folder / IMU).exists() or (folder / GPS).exists():
        return read_gtsam_kitti(folder)
    wanted = (
        f"EuRoC's mav0/imu0, KITTI's {OXTS}/timestamps.txt and {OXTS}/data, {IMU} and {GPS}, a rosbag2 folder, or the "
        "graph.txt and submaps of a map that GLIM has saved"
    )
    raise FormatError(str(path), None, "a folder without a log or a recording that is known", wanted)
