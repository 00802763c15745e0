"""A simulated drive with all that a recording can have, written by rosbags alone: odometry that drifts, a front end's
graph with loop closures, GNSS, an IMU, and where the sensors are.  A file that ends in .mcap or .bag (ROS 1), else a
folder of rosbag2 (SQLite):

    python tests/ros2/full_drive.py drive.mcap
"""

import argparse
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.rosbag1 import Writer as Bag1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Bag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from factorbus.client.frames import compose, inverse
from factorbus.client.geodetic import geodetic
from factorbus.proto.arrays import F64
from factorbus.simulate import inertial

START_NS = 1_700_000_000 * 10**9
ORIGIN = (48.1, 11.5, 500.0)
MOUNT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.sin(0.5), math.cos(0.5)])  # of the IMU, turned about z
BEGIN = np.array([1.0, -2.0, 0.5, math.sin(0.02), 0.0, 0.0, math.cos(0.02)])  # of odometry: it leans a little
IMU_NOISE = (1e-3, 1e-2, 1e-5, 1e-4)  # for --imu-noise
SIGMA_FIX = np.array([0.5, 0.5, 1.0])
SIGMA_CLOSURE = np.repeat([0.1, 0.02], 3)
FIRST_FIX_S = 8.0  # before that the receiver has none
_SAMPLES_EACH, _NODES_EACH = 20, 5  # samples for each odometry, odometries for each node of the graph
_LEAST_AGO_S, _NEAR_M = 30.0, 4.0  # of a place that is seen again

TF, ODOM, FIX, IMU, GRAPH = "/tf_static", "/odom", "/gps/fix", "/imu/data_raw", "/kimera/pose_graph"
TYPES = {
    TF: "tf2_msgs/msg/TFMessage",
    ODOM: "nav_msgs/msg/Odometry",
    FIX: "sensor_msgs/msg/NavSatFix",
    IMU: "sensor_msgs/msg/Imu",
    GRAPH: "pose_graph_tools_msgs/msg/PoseGraph",
}
_DEFINED = {
    "pose_graph_tools_msgs/msg/PoseGraphNode": (
        "std_msgs/Header header\nint32 robot_id\nuint64 key\ngeometry_msgs/Pose pose\n"
    ),
    "pose_graph_tools_msgs/msg/PoseGraphEdge": (
        "std_msgs/Header header\nuint64 key_from\nuint64 key_to\nint32 robot_from\nint32 robot_to\nint32 type\n"
        "geometry_msgs/Pose pose\nfloat64[36] covariance\n"
    ),
    TYPES[GRAPH]: (
        "std_msgs/Header header\npose_graph_tools_msgs/PoseGraphNode[] nodes\n"
        "pose_graph_tools_msgs/PoseGraphEdge[] edges\n"
    ),
}


class FullDrive(NamedTuple):
    """Times are seconds.  imu (n, 7): time, rates and accelerations along the IMU's axes.  odometry: (time, told).

    truth (k, 7): of each odometry, in the frame of odometry.  fixes: (time, metres east, north, up of ORIGIN).
    closures: (earlier, later, measured), numbers of odometries.  lever: of the antenna.  frame: T_enu_map.
    """

    imu: F64
    odometry: list[tuple[float, F64]]
    truth: F64
    bias: F64
    fixes: list[tuple[float, F64]]
    closures: list[tuple[int, int, F64]]
    lever: F64
    frame: F64


def full_drive(seconds: int = 200, seed: int = 1) -> FullDrive:
    """The course closes after 157 s: from then on it is driven again."""
    world, random = inertial(2 * seconds + 1, seed), np.random.default_rng([seed, 10])
    imu = world.imu.copy()
    turn = inverse(np.array([0.0, 0.0, 0.0, *MOUNT[3:]]))
    for columns in (slice(1, 4), slice(4, 7)):
        imu[:, columns] = _turned(turn, imu[:, columns])
    rows = world.truth[::_SAMPLES_EACH]
    times, poses = rows[:, 0], rows[:, 1:]
    begin = compose(BEGIN, inverse(poses[0])[None])[0]
    truth = compose(begin, poses)
    bias = np.concatenate([_turned(turn, world.bias[None, :3])[0], _turned(turn, world.bias[None, 3:])[0]])
    fixes = [(row[0], row[1:]) for row in world.gnss if row[0] >= FIRST_FIX_S]
    told, frame = _told(truth, random), compose(world.frame, inverse(begin)[None])[0]
    return FullDrive(
        imu, list(zip(times.tolist(), told, strict=True)), truth, bias, fixes, _closures(times, truth, random),
        world.lever, frame,
    )  # fmt: skip


def _told(truth: F64, random: np.random.Generator) -> list[F64]:
    """Odometry that errs by 2 % of the way and turns by 0.01 rad for each metre."""
    told = [truth[0]]
    for before, after in pairwise(truth):
        step = compose(inverse(before), after[None])[0]
        metres, radians = np.linalg.norm(step[:3]), 2 * math.acos(min(1.0, abs(step[6])))
        sigmas = np.repeat([0.02 * metres, 0.01 * metres + 0.02 * radians], 3)
        told.append(compose(told[-1], compose(step, _small(random.normal(0, 1, 6) * sigmas)))[0])
    return told


def _closures(times: F64, truth: F64, random: np.random.Generator) -> list[tuple[int, int, F64]]:
    """Of each node the nearest one of long ago, if that is near."""
    found = []
    nodes = [n for n in range(0, len(times), _NODES_EACH) if times[n] >= FIRST_FIX_S]
    for n in nodes:
        earlier = [k for k in nodes if times[n] - times[k] > _LEAST_AGO_S]
        away = [float(np.linalg.norm(truth[n, :3] - truth[k, :3])) for k in earlier]
        if away and min(away) < _NEAR_M:
            k = earlier[int(np.argmin(away))]
            where = compose(inverse(truth[k]), truth[n][None])[0]
            found.append((k, n, compose(where, _small(random.normal(0, 1, 6) * SIGMA_CLOSURE))[0]))
    return found


def _turned(by: F64, vectors: F64) -> F64:
    return compose(by, np.column_stack([vectors, np.tile([0.0, 0.0, 0.0, 1.0], (len(vectors), 1))]))[:, :3]


def _small(by: F64) -> F64:
    """(1, 7): metres, a rotation vector."""
    angle = float(np.linalg.norm(by[3:]))
    return np.array([[*by[:3], *(np.sinc(angle / 2 / np.pi) * by[3:] / 2), math.cos(angle / 2)]])


def at(seconds: float) -> int:
    """Its stamp, ns."""
    return START_NS + round(seconds * 1e9)


class RosWords:
    """Messages of one generation of ROS; said (topic, when, message), in the order in which they are heard."""

    def __init__(self, ros1: bool) -> None:
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
        for name, text in _DEFINED.items():
            self.store.register(get_types_from_msg(text, name))
        if ros1:
            self.store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TYPES[TF]))
        known = {name.split("/")[-1]: kind for name, kind in self.store.types.items()}
        known["Time"] = self.store.types["builtin_interfaces/msg/Time"]  # std_msgs of ROS 1 has one, too
        self._ros1, self._types = ros1, known

    def serialize(self, topic: str, message: Any) -> bytes:
        """As the generation has it."""
        serialize: Callable[..., Any] = self.store.serialize_ros1 if self._ros1 else self.store.serialize_cdr
        return bytes(serialize(message, TYPES[topic]))

    def said(self, drive: FullDrive) -> Iterator[tuple[str, int, Any]]:
        """All of it; the lateness of each topic tells what comes first of what was measured at once."""
        said = [(at(t), IMU, self._imu(at(t), rates)) for t, *rates in drive.imu.tolist()]
        said += [(at(t) + 100_000, ODOM, self._odometry(at(t), row)) for t, row in drive.odometry]
        said += [(at(t) + 200_000, FIX, self._fix(at(t), row)) for t, row in drive.fixes]
        said += [(at(t) + 200_000, FIX, self._fix(at(t), None)) for t in range(math.ceil(FIRST_FIX_S))]
        said += self._graphs(drive)
        yield TF, START_NS, self._mounts(drive)
        yield from ((topic, ns, message) for ns, topic, message in sorted(said, key=lambda each: each[0]))

    def _header(self, ns: int, frame: str) -> Any:
        number = (0,) if self._ros1 else ()
        return self._types["Header"](*number, self._types["Time"](ns // 10**9, ns % 10**9), frame)

    def _vector(self, row: Any, kind: str = "Vector3") -> Any:
        return self._types[kind](*map(float, row))

    def _pose(self, row: F64) -> Any:
        return self._types["Pose"](self._vector(row[:3], "Point"), self._vector(row[3:], "Quaternion"))

    def _mounts(self, drive: FullDrive) -> Any:
        there = {"imu_link": MOUNT, "gps": np.array([*drive.lever, 0.0, 0.0, 0.0, 1.0])}
        made = [
            self._types["TransformStamped"](
                self._header(START_NS, "base_link"), frame,
                self._types["Transform"](self._vector(row[:3]), self._vector(row[3:], "Quaternion")),
            )
            for frame, row in there.items()
        ]  # fmt: skip
        return self._types["TFMessage"](made)

    def _odometry(self, ns: int, row: F64) -> Any:
        """With covariances of zeros, as many drivers send them."""
        still = self._types["Twist"](self._vector([0.0] * 3), self._vector([0.0] * 3))
        where = self._types["PoseWithCovariance"](self._pose(row), np.zeros(36))
        twist = self._types["TwistWithCovariance"](still, np.zeros(36))
        return self._types["Odometry"](self._header(ns, "odom"), "base_link", where, twist)

    def _imu(self, ns: int, rates: list[float]) -> Any:
        none = np.zeros(9)
        turn = self._vector([0.0, 0.0, 0.0, 1.0], "Quaternion")
        without = np.array([-1.0] + [0.0] * 8)
        header = self._header(ns, "imu_link")
        return self._types["Imu"](
            header, turn, without, self._vector(rates[:3]), none, self._vector(rates[3:]), none
        )  # fmt: skip

    def _fix(self, ns: int, row: F64 | None) -> Any:
        place = (0.0, 0.0, 0.0) if row is None else geodetic(row, ORIGIN).tolist()
        status = self._types["NavSatStatus"](-1 if row is None else 0, 1)
        return self._types["NavSatFix"](self._header(ns, "gps"), status, *place, np.diag(SIGMA_FIX**2).ravel(), 2)

    def _graphs(self, drive: FullDrive) -> Iterator[tuple[int, str, Any]]:
        """Each node as it comes, with its edge of odometry and its closures."""
        for n in range(0, len(drive.odometry), _NODES_EACH):
            ns = at(drive.odometry[n][0])
            edges = [(a, b, 1, where) for a, b, where in drive.closures if b == n]
            if n:
                last = drive.odometry[n - _NODES_EACH][1]
                edges.append((n - _NODES_EACH, n, 0, compose(inverse(last), drive.odometry[n][1][None])[0]))
            node = self._types["PoseGraphNode"](self._header(ns, "map"), 0, n, self._pose(drive.odometry[n][1]))
            covariance = np.diag(SIGMA_CLOSURE**2).ravel()
            joined = [
                self._types["PoseGraphEdge"](self._header(ns, "map"), a, b, 0, 0, kind, self._pose(where), covariance)
                for a, b, kind, where in edges
            ]
            yield ns + 300_000, GRAPH, self._types["PoseGraph"](self._header(ns, "map"), [node], joined)


def write(path: Path, drive: FullDrive) -> Path:
    """By the ending of the path, which must not be there yet."""
    return write_robots(path, {"": drive})


def write_robots(path: Path, drives: Mapping[str, FullDrive]) -> Path:
    """The same of several robots, whose topics begin with their names: "/one"."""
    if path.exists():
        raise FileExistsError(f"{path} is there already")
    if path.suffix == ".bag":
        with Bag1Writer(path) as bag:
            _fill(bag, RosWords(ros1=True), drives)
    elif path.suffix == ".mcap":  # the one of a folder
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            with Bag2Writer(Path(folder) / "bag", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
                _fill(writer, RosWords(ros1=False), drives)
            (file,) = (Path(folder) / "bag").glob("*.mcap")
            shutil.move(file, path)
    else:
        with Bag2Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            _fill(writer, RosWords(ros1=False), drives)
    return path


def _fill(writer: Any, words: RosWords, drives: Mapping[str, FullDrive]) -> None:
    topics = {
        robot + name: writer.add_connection(robot + name, kind, typestore=words.store)
        for robot in drives
        for name, kind in TYPES.items()
    }
    said = [(ns, robot, topic, message) for robot, drive in drives.items() for topic, ns, message in words.said(drive)]
    for ns, robot, topic, message in sorted(said, key=lambda each: each[0]):
        writer.write(topics[robot + topic], ns, words.serialize(topic, message))


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("path", type=Path)
    asked.add_argument("--seconds", type=int, default=200)
    asked.add_argument("--seed", type=int, default=1)
    given = asked.parse_args()
    made = full_drive(given.seconds, given.seed)
    write(given.path, made)
    print(f"{given.path}: {given.seconds} s, {len(made.odometry)} odometries, {len(made.imu)} samples of an IMU, "
          f"{len(made.fixes)} fixes, {len(made.closures)} loop closures")  # fmt: skip
