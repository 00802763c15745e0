"""Maps as GLIM saves them: the lines of `GlobalMapping::save` and `SubMap::save`, and a drive for them.

The drive is around a square, five frames a submap; its odometry turns too far by a little with each frame.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from boost_writing import BOOST_1_74, TRACKED_IN_GLIM, Factor, Noise, archives

from factorbus.proto.symbols import symbol

FRAMES = 5
T_LIDAR_IMU = np.array([[0.0, -1, 0, 0.1], [1, 0, 0, 0], [0, 0, 1, -0.2], [0, 0, 0, 1]])
BETWEEN = "gtsam::BetweenFactor<gtsam::Pose3>"
_FIRST_STAMP = "1700000000.100000001"


@dataclass(frozen=True)
class DumpedSubmap:
    """T_world_origin: as GLIM has optimized it.  odometry: of the lidar at each frame, as measured."""

    T_world_origin: np.ndarray
    odometry: list[np.ndarray]
    first_id: int

    def origin(self) -> np.ndarray:
        return self.odometry[len(self.odometry) // 2]


def turned(x: float, y: float, yaw: float, z: float = 0.0) -> np.ndarray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def square_drive(submaps: int, drift: float = 0.002) -> list[DumpedSubmap]:
    """Lidar poses; a frame every metre, a corner every ten submaps, and GLIM's estimate is the truth."""
    truth, odometry, made = turned(0, 0, 0), turned(0, 0, 0), []
    for number in range(submaps):
        seen, drifted = [], []
        for frame in range(FRAMES):
            corner = math.pi / 2 if (number * FRAMES + frame) % (10 * FRAMES) == 10 * FRAMES - 1 else 0.0
            seen.append(truth)
            drifted.append(odometry)
            truth, odometry = truth @ turned(1, 0, corner), odometry @ turned(1, 0, corner + drift)
        made.append(DumpedSubmap(seen[FRAMES // 2], drifted, number * FRAMES))
    return made


def saved(
    folder: Path,
    submaps: Sequence[DumpedSubmap],
    costs: Sequence[tuple[str, int, int]] = (),
    factors: Sequence[Factor | None] | None = None,
    imu: bool = False,
    more: str = "",
) -> Path:
    """Save a map.  factors: of graph.bin, None: there is none   imu: poses are of it   more: lines of graph.txt."""
    folder.mkdir()
    count = sum(len(submap.odometry) for submap in submaps)
    lines = [f"num_submaps: {len(submaps)}", f"num_all_frames: {count}", f"num_matching_cost_factors: {len(costs)}"]
    lines += [f"matching_cost {method} {first} {second}" for method, first, second in costs]
    (folder / "graph.txt").write_text("\n".join(lines) + "\n" + more)
    if factors is not None:
        (folder / "graph.bin").write_bytes(archives(list(factors), TRACKED_IN_GLIM, BOOST_1_74)[1])
    for number, submap in enumerate(submaps):
        (folder / f"{number:06d}").mkdir()
        (folder / f"{number:06d}" / "data.txt").write_text(_data_text(number, submap, imu))
    return folder


def _data_text(number: int, submap: DumpedSubmap, imu: bool) -> str:
    to_sensor = T_LIDAR_IMU if imu else np.eye(4)
    origin = submap.origin() @ to_sensor
    ends = [np.linalg.inv(origin) @ submap.odometry[frame] @ to_sensor for frame in (0, -1)]
    text = f"id: {number}\nT_world_origin: \n{_matrix(submap.T_world_origin @ to_sensor)}"
    text += "".join(f"T_origin_endpoint_{side}: \n{_matrix(T)}" for side, T in zip("LR", ends, strict=True))
    text += f"T_lidar_imu: \n{_matrix(T_LIDAR_IMU)}imu_bias: 0 0 0 0.01 -1e-05 0\nframe_id: {2 if imu else 1}\n"
    text += f"num_frames: {len(submap.odometry)}\n"
    for frame, T in enumerate(submap.odometry):
        text += f"frame_{frame}\nid: {submap.first_id + frame}\nstamp: {stamp_text(submap.first_id + frame)}\n"
        text += f"T_odom_lidar: \n{_matrix(T)}T_world_lidar: \n{_matrix(T)}v_world_imu: 1 0 -1e-10\n"
    return text


def stamp_text(frame: int) -> str:
    """Ten frames a second, to the nanosecond."""
    seconds, rest = _FIRST_STAMP.split(".")
    tenths, nanoseconds = divmod(int(rest) + frame * 10**8, 10**9)
    return f"{int(seconds) + tenths}.{nanoseconds:09d}"


def _matrix(T: np.ndarray) -> str:
    """As Eigen prints one: six digits, columns of one width."""
    words = [[f"{number:.6g}" for number in row] for row in T.tolist()]
    width = max(len(word) for row in words for word in row)
    return "".join(" ".join(word.rjust(width) for word in row) + "\n" for row in words)


def between(first: int, second: int, T: np.ndarray, noise: Noise) -> Factor:
    """A BetweenFactor of two submaps."""
    return Factor(BETWEEN, (symbol("x", first), symbol("x", second)), noise, T[:3, :3], T[:3, 3])


def damping(number: int = 0) -> Factor:
    """What GLIM holds the first submap with."""
    return Factor("gtsam_points::LinearDampingFactor", (symbol("x", number),))


def pose_graph(submaps: Sequence[DumpedSubmap], loops: Sequence[tuple[int, int]] = ()) -> list[Factor]:
    """What GlobalMappingPoseGraph has: odometry between neighbours, and loops with Huber's loss, as they truly are."""
    steps = [
        between(one, one + 1, np.linalg.inv(submaps[one].origin()) @ submaps[one + 1].origin(), Noise(6, 1e-3))
        for one in range(len(submaps) - 1)
    ]
    closed = [
        between(
            one,
            other,
            np.linalg.inv(submaps[one].T_world_origin) @ submaps[other].T_world_origin,
            Noise(6, 0.1, huber=1.0),
        )
        for one, other in loops
    ]
    return [damping(), *steps, *closed]
