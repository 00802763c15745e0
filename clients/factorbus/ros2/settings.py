"""The settings of a bridge: topics, frames, when there is a keyframe, how certain anything may be."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from factorbus.client.imu import ImuNoise
from factorbus.proto.symbols import symbol
from factorbus.ros2.geometry import Transform, from_quaternion
from factorbus.ros2.message_parts import frame_name
from factorbus.ros2.messages import (
    DETECTIONS,
    FIX,
    IMU,
    LANDMARK_LIST,
    LINK,
    MAP_GRAPH,
    ODOMETRY,
    POSE,
    POSE_GRAPH,
    TAGS,
)  # fmt: skip
from factorbus.ros2.options import USUAL_IMU_NOISE, BridgeOptions, RobotOptions
from factorbus.ros2.problems import BadRosName

USUAL_POSES, USUAL_LANDMARKS = ("/initialpose",), ("/detections",)
# Of the keys of what an IMU adds: velocities, biases, gravity.
INERTIAL_LETTERS = VELOCITY_LETTER, BIAS_LETTER, GRAVITY_LETTER = "V", "B", "G"
# Of the key of the map's pose in the frame of GNSS, and the topic of the frames of sensors.
FRAME_LETTER, STATIC = "f", "/tf_static"
# In the place of topics: none of that kind is read.
NOTHING = "none"
_SEVERAL = ("poses", "landmarks", "landmark_lists", "tags", "pose_graphs", "map_graphs", "links", "fixes")
LANDMARK_LETTER = "l"


@dataclass(frozen=True, slots=True)
class Floors:
    """Standard deviations below which no measurement counts; see `certainty`.

    Of odometry between keyframes: `drift_m` metres and `drift_rad` radians per metre driven, `turn_rad` radians per
    radian turned, and never less than `least_m`, `least_rad`.  Poses: `pose_m`, `pose_rad`, landmarks: `landmark_m`,
    closures: `closure_m`, `closure_rad`, fixes of GNSS: `fix_m`.
    """

    drift_m: float = 0.02
    drift_rad: float = 0.01
    turn_rad: float = 0.02
    least_m: float = 0.001
    least_rad: float = 0.001
    pose_m: float = 0.01
    pose_rad: float = 0.01
    landmark_m: float = 0.01
    closure_m: float = 0.05
    closure_rad: float = 0.02
    fix_m: float = 0.01


@dataclass(frozen=True, slots=True)
class Settings:
    """space: "plane" (se2, point2) or "space" (se3, point3).  letter, landmark_letter: of the keys.
    start: "odometry": the map begins where odometry does; "pose": with the first pose that is received.
    keyframe_m, keyframe_rad: a keyframe when that far or that much turned since the last.
    mounts: frame of a sensor to T_base_sensor.  tolerance_s: by how much transforms are stamped ahead.
    smooth_s: over how long a correction of transforms is blended; with it raw_transforms has them as they are.
    display_s: least time between paths.  fix_sigma_m: of fixes that do not say how good they are.
    robot_id: which robot of pose graphs this one is; None: the first that is heard.
    rotation_first: the covariances of pose graphs have rotation before translation, as GTSAM's.
    without: names of fields with topics of which none is to be read, also where some are usual or found.
    """

    odometry: str = "/odom"
    poses: tuple[str, ...] = USUAL_POSES
    landmarks: tuple[str, ...] = USUAL_LANDMARKS
    landmark_lists: tuple[str, ...] = ()
    tags: tuple[str, ...] = ()
    pose_graphs: tuple[str, ...] = ()
    map_graphs: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    fixes: tuple[str, ...] = ()
    imu: str = ""
    path: str = "/factorbus/path"
    markers: str = "/factorbus/markers"
    pose: str = "/factorbus/pose"
    transforms: str = "/tf"
    raw_transforms: str = "/factorbus/tf_raw"
    map_frame: str = "map"
    space: str = "plane"
    letter: str = "x"
    landmark_letter: str = LANDMARK_LETTER
    start: str = "odometry"
    keyframe_m: float = 0.5
    keyframe_rad: float = 0.35
    tolerance_s: float = 0.1
    smooth_s: float = 0.0
    display_s: float = 1.0
    fix_sigma_m: float = 5.0
    imu_noise: ImuNoise = field(default_factory=lambda: ImuNoise(*USUAL_IMU_NOISE))
    robot_id: int | None = None
    rotation_first: bool = False
    mounts: Mapping[str, Transform] = field(default_factory=dict)
    floors: Floors = field(default_factory=Floors)
    without: frozenset[str] = frozenset()

    def inputs(self) -> dict[str, str]:
        """Topics that are read, odometry first, with the type of each.  Raises BadRosName: one is of two types."""
        groups = (((self.odometry,), ODOMETRY), (self.poses, POSE), (self.landmarks, DETECTIONS),
                  (self.landmark_lists, LANDMARK_LIST), (self.tags, TAGS), (self.pose_graphs, POSE_GRAPH),
                  (self.map_graphs, MAP_GRAPH), (self.links, LINK), (self.fixes, FIX), ((self.imu,), IMU))  # fmt: skip
        made: dict[str, str] = {}
        for name, type_name in ((name, type_name) for names, type_name in groups for name in names if name):
            if made.setdefault(name, type_name) != type_name:
                raise BadRosName("the topic", name, f"one type of it: here it is of {made[name]} and of {type_name}")
        return made


def bridge_settings(options: BridgeOptions) -> Settings:
    """Of a bridge.  Raises BadRosName, BadSymbol."""
    if options.tf_raw == options.tf:
        raise BadRosName("the topic", options.tf_raw, "one for each of --tf and --tf-raw: both are map to odometry")
    if not options.smooth_s and options.tf_raw != Settings().raw_transforms:
        raise BadRosName(
            "--tf-raw", options.tf_raw, "--smooth-s with it: without, --tf has transforms as the map has them"
        )
    given = robot_settings(options)
    if not given.odometry:
        raise BadRosName(
            "the topic of odometry", given.odometry, "a full ROS name, such as /odom: a map is driven by it"
        )
    # Without these options the usual topics are read.
    made = replace(
        given,
        poses=given.poses or (() if "poses" in given.without else USUAL_POSES),
        landmarks=given.landmarks or (() if "landmarks" in given.without else USUAL_LANDMARKS),
        path=options.path,
        markers=options.markers,
        pose=options.pose_out,
        transforms=options.tf,
        raw_transforms=options.tf_raw,
        tolerance_s=options.tolerance,
        smooth_s=options.smooth_s,
        display_s=options.display,
    )
    made.inputs()
    return made


def robot_settings(options: RobotOptions) -> Settings:
    """Of a robot, with the topics that were given and no others.  Raises BadRosName, BadSymbol."""
    symbol(options.letter, 0)
    if options.letter == FRAME_LETTER:
        raise BadRosName("the letter", options.letter, f"another one: {FRAME_LETTER}0 is the frame of GNSS")
    if options.letter == LANDMARK_LETTER:
        raise BadRosName("the letter", options.letter, "another one: this is that of landmarks")
    if options.imu and options.letter in INERTIAL_LETTERS:
        raise BadRosName("the letter", options.letter, "another one: this is that of velocities, biases or gravity")
    if options.imu and not options.space:
        raise BadRosName("the IMU", options.imu, "poses in space, --space: in the plane there is no inertial factor")
    if not options.imu and tuple(options.imu_noise) != USUAL_IMU_NOISE:
        raise BadRosName("--imu-noise", str(tuple(options.imu_noise)), "--imu with the topic of the IMU that it is of")
    made = Settings(
        odometry=options.odom,
        fix_sigma_m=options.fix_sigma,
        imu=options.imu,
        imu_noise=ImuNoise(*options.imu_noise),
        robot_id=options.robot_id,
        rotation_first=options.rotation_first,
        map_frame=frame_name(options.map_frame),
        space="space" if options.space else "plane",
        letter=options.letter,
        start=options.start,
        keyframe_m=options.keyframe[0],
        keyframe_rad=options.keyframe[1],
        mounts=dict(map(_mount, options.mounts)),
        floors=Floors(drift_m=options.drift[0], drift_rad=options.drift[0] / 2, turn_rad=options.drift[1]),
    )
    return _with_several(made, options)


def _with_several(settings: Settings, options: RobotOptions) -> Settings:
    """With the topics that may be several, or none.  Raises BadRosName."""
    named = {name: tuple(getattr(options, name)) for name in _SEVERAL}
    for topics in named.values():
        if NOTHING in topics and len(topics) > 1:
            raise BadRosName("the topic", NOTHING, "topics, or none alone")
    without = frozenset(name for name, topics in named.items() if topics == (NOTHING,))
    if settings.start == "pose" and "poses" in without:
        raise BadRosName("the topic of poses", NOTHING, "one of poses: --start pose waits for the first")
    made = replace(settings, **named | dict.fromkeys(without, ()), without=without)
    made.inputs()
    return made


def _mount(text: str) -> tuple[str, Transform]:
    """FRAME=x,y,z,qx,qy,qz,qw."""
    frame, _, numbers = text.partition("=")
    try:
        x, y, z, *quat_xyzw = (float(number) for number in numbers.split(","))
        return frame, from_quaternion((x, y, z), quat_xyzw)
    except ValueError:
        raise BadRosName("the mount", text, "FRAME=x,y,z,qx,qy,qz,qw with a unit quaternion") from None
