"""The options of commands that are about a robot, as they were given."""

from collections.abc import Sequence
from dataclasses import dataclass

# Of gyroscopes and accelerometers (rad/s/√Hz, m/s²/√Hz) and the walks of their biases (per √s): EuRoC's ADIS16448, by
# the sensor.yaml of that data set.
USUAL_IMU_NOISE = (1.6968e-4, 2.0e-3, 1.9393e-5, 3.0e-3)


@dataclass(frozen=True, slots=True, kw_only=True)
class RobotOptions:
    """The options of `factorbus ros2` and `factorbus replay` that are about a robot, under the command line's names.

    odom, poses, landmarks, landmark_lists, tags: topics.  space: poses in space.  keyframe: metres, radians.
    mounts: FRAME=x,y,z,qx,qy,qz,qw.  drift: per metre, per radian.
    imu: a topic.  imu_noise: as of `ImuNoise`; without, that of EuRoC's ADIS16448.
    pose_graphs, map_graphs, links, fixes: topics.  fix_sigma: metres.  robot_id: in pose graphs; None: the first.
    """

    odom: str
    poses: Sequence[str]
    landmarks: Sequence[str]
    map_frame: str
    space: bool
    letter: str
    start: str
    keyframe: tuple[float, float]
    mounts: Sequence[str]
    drift: tuple[float, float]
    landmark_lists: Sequence[str] = ()
    tags: Sequence[str] = ()
    pose_graphs: Sequence[str] = ()
    map_graphs: Sequence[str] = ()
    links: Sequence[str] = ()
    fixes: Sequence[str] = ()
    fix_sigma: float = 5.0
    robot_id: int | None = None
    rotation_first: bool = False
    imu: str = ""
    imu_noise: tuple[float, float, float, float] = USUAL_IMU_NOISE


@dataclass(frozen=True, slots=True, kw_only=True)
class BridgeOptions(RobotOptions):
    """Those of `factorbus ros2`, and what it publishes.

    tf, tf_raw, path, markers, pose_out: topics.  tolerance, smooth_s, display: seconds.
    """

    tf: str
    tf_raw: str
    path: str
    markers: str
    pose_out: str
    tolerance: float
    smooth_s: float
    display: float
