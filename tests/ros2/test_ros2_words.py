"""Names, type hashes, attachments and CDR, each against somebody else's."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest
import ros
import words
from hypothesis import given
from hypothesis import strategies as st

from factorbus.cli.commands.ros2 import DISTRIBUTIONS
from factorbus.cli.main import main
from factorbus.cli.output.exits import USAGE
from factorbus.client import Snapshot
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol
from factorbus.ros2 import display, messages
from factorbus.ros2.geometry import from_plane, from_quaternion
from factorbus.ros2.messages import (
    DETECTIONS,
    FIX,
    LANDMARK_LIST,
    LINK,
    MAP_GRAPH,
    MARKERS,
    ODOMETRY,
    PATH,
    POSE,
    POSE_GRAPH,
    TAGS,
    TRANSFORMS,
    Messages,
)
from factorbus.ros2.names import NodeName, Topic, attachment, gid
from factorbus.ros2.options import BridgeOptions
from factorbus.ros2.problems import BadRosMessage, BadRosName
from factorbus.ros2.settings import Settings, bridge_settings

MESSAGES = Messages("jazzy")
TYPES = {
    ODOMETRY: words.Odometry,
    POSE: words.PoseWithCovarianceStamped,
    DETECTIONS: words.Detection3DArray,
    LANDMARK_LIST: words.LandmarkList,
    TAGS: words.AprilTagDetectionArray,
    PATH: words.Path,
    TRANSFORMS: words.TFMessage,
    MARKERS: words.MarkerArray,
    FIX: words.NavSatFix,
    POSE_GRAPH: words.PoseGraph,
    MAP_GRAPH: words.MapGraph,
    LINK: words.Link,
}
STRING = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"


def test_names_are_those_of_the_design_document_of_rmw_zenoh() -> None:
    """Its examples: the talker of demo_nodes_cpp."""
    talker = NodeName("8b20917502ee955ac4476e0266340d5c", 2, "/", "talker")
    chatter = Topic("/chatter", "std_msgs/msg/String", STRING, 7)
    assert chatter.key(0) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING}"
    assert Topic("/robot1/chatter", "std_msgs/msg/String", STRING).key(0) == (
        f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING}"
    )
    listener = NodeName("aac3178e146ba6f1fc6e6a4085e77f21", 2, "/", "listener")
    assert listener.token() == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    assert talker.endpoint_token(10, "MP", chatter) == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/"
        f"std_msgs::msg::dds_::String_/{STRING}/::,7:,:,:,,"
    )
    static = Topic("/tf_static", "tf2_msgs/msg/TFMessage", STRING, 100)
    assert talker.endpoint_token(11, "MS", static, kept=True).endswith("/:1:,100:,:,:,,")
    assert NodeName("a", 0, "/robot1", "n").token() == "@ros2_lv/0/a/0/0/NN/%/%robot1/n"


@pytest.mark.parametrize("name", list(TYPES))
def test_type_hashes_agree_with_a_computation_of_their_own(name: str) -> None:
    assert MESSAGES.hash(name) == words.type_hash(TYPES[name])


def test_type_hashes_are_those_seen_on_robots() -> None:
    """As others have published them; they are the same in all distributions that have any."""
    for distribution in DISTRIBUTIONS:
        store = Messages(distribution)
        if distribution == "humble":
            assert store.hash(ODOMETRY) == messages.NO_HASH
            continue
        assert store.hash("std_msgs/msg/String") == STRING
        assert store.hash(ODOMETRY) == "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"
        assert store.hash(TRANSFORMS) == "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
        # As rosidl wrote them for the packages themselves.
        assert store.hash(POSE_GRAPH) == "RIHS01_1010611eb14adb91140b5debb288865bf9881ad35835622b2e3a0fc5c905fb32"
        assert store.hash(MAP_GRAPH) == "RIHS01_25c8097ccc472a2134e59113106a13302b0025829ef39e2066e2075fa84228c4"
        assert store.hash(LINK) == "RIHS01_764301c2d5f3045b5f97420bd64629321ecef724a6010e3dfe5f5c3d4ce7ac0a"
        assert [store.hash(name) for name in TYPES] == [MESSAGES.hash(name) for name in TYPES]
    assert set(DISTRIBUTIONS) == set(messages.DISTRIBUTIONS)


@given(st.integers(0, 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_attachments_are_read_by_zenohs_own_serialization(number: int, stamp: int, of: bytes) -> None:
    assert ros.read_attachment(attachment(number, stamp, of)) == (number, stamp, of)


def test_gids_tell_endpoints_apart() -> None:
    assert len(gid("one")) == 16
    assert gid("one") != gid("two")


numbers = st.floats(-1e6, 1e6)
names = st.text(st.characters(codec="ascii", min_codepoint=33), max_size=12)


@given(
    st.integers(0, 2**31 - 1), st.integers(0, 10**9 - 1), names, names, st.lists(numbers, min_size=36, max_size=36),
    st.tuples(numbers, numbers, numbers),
)  # fmt: skip
def test_odometry_of_another_library_is_read_whole(
    sec: int, nanosec: int, frame: str, child: str, covariance: list[float], where: tuple[float, float, float]
) -> None:
    made = ros.odometry(0, where)
    made.header = words.Header(words.Time(sec, nanosec), frame)
    made.child_frame_id = child
    made.twist.covariance = covariance
    read = MESSAGES.read("/odom", ODOMETRY, bytes(made.serialize()))
    assert (read.header.stamp.sec, read.header.stamp.nanosec, read.header.frame_id) == (sec, nanosec, frame)
    assert read.child_frame_id == child
    np.testing.assert_array_equal(read.twist.covariance, covariance)
    assert (read.pose.pose.position.x, read.pose.pose.position.y) == where[:2]
    assert MESSAGES.write(ODOMETRY, read)[4:] == bytes(made.serialize())[4:]


@given(st.lists(st.tuples(names, st.tuples(numbers, numbers, numbers), st.floats(0, 10)), max_size=5), names)
def test_detections_of_another_library_are_read_whole(
    seen: list[tuple[str, tuple[float, float, float], float]], frame: str
) -> None:
    read = MESSAGES.read("/d", DETECTIONS, bytes(ros.detections(17, frame, seen).serialize()))
    assert read.header.frame_id == frame
    for each, (identity, (x, y, z), sigma) in zip(read.detections, seen, strict=True):
        place = each.results[0].pose.pose.position
        assert (each.results[0].hypothesis.class_id, place.x, place.y, place.z) == (identity, x, y, z)
        assert each.results[0].pose.covariance[7] == sigma**2


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    for name in TYPES:
        for begin in (b"", b"\0\1\0\0", b"\0\0\0\0"):
            with contextlib.suppress(BadRosMessage):
                MESSAGES.read("/t", name, begin + data)


def test_a_message_that_is_cut_is_refused() -> None:
    whole = bytes(ros.odometry(0, (1.0, 2.0, 3.0)).serialize())
    for length in range(0, len(whole) - 4, 7):
        with pytest.raises(BadRosMessage, match="cannot be read"):
            MESSAGES.read("/odom", ODOMETRY, whole[:length])


def test_what_is_published_is_read_by_another_library() -> None:
    random = np.random.default_rng(3)
    quats = random.normal(size=(4, 4))
    quats /= np.linalg.norm(quats, axis=1)[:, None] * np.where(quats[:, 3:] < 0, -1, 1)
    keys = np.array([symbol("x", n) for n in range(3)] + [symbol("y", 0)])
    snapshot = Snapshot(1, 1, {
        "se3": (keys, np.hstack([random.normal(size=(4, 3)), quats])),
        "point3": (np.array([symbol("l", 1)]), np.array([[1.0, 2.0, 3.0]])),
    }, {"se3": np.array([1_499_999_999, NO_STAMP, -5, 8]), "point3": np.array([NO_STAMP])})  # fmt: skip
    settings = Settings(space="space")
    path = words.Path.deserialize(display.path(MESSAGES, settings, snapshot, 1_500_000_000))
    assert (path.header.stamp.sec, path.header.stamp.nanosec, path.header.frame_id) == (1, 500_000_000, "map")
    stamps = [(each.header.stamp.sec, each.header.stamp.nanosec) for each in path.poses]
    assert stamps == [(1, 499_999_999), (1, 500_000_000), (1, 500_000_000)], "its own, and what ROS has a place for"
    read = [each.pose for each in path.poses]  # of this robot only
    np.testing.assert_allclose(
        [[p.position.x, p.position.y, p.position.z] for p in read], snapshot.columns["se3"][1][:3, :3]
    )
    turns = [[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in read]
    np.testing.assert_allclose(turns, quats[:3], atol=1e-12)
    markers = words.MarkerArray.deserialize(display.markers(MESSAGES, settings, snapshot, 0)).markers
    assert [(m.ns, m.type, len(m.points)) for m in markers] == [("landmarks", 7, 1), ("poses", 8, 4)]
    assert (markers[0].points[0].x, markers[0].points[0].z, markers[0].color.a) == (1.0, 3.0, 1.0)
    T = from_plane(1.0, -2.0, 3.0)
    (sent,) = words.TFMessage.deserialize(display.transform(MESSAGES, settings, "odom", T, 7)).transforms
    assert (sent.header.frame_id, sent.child_frame_id, sent.header.stamp.nanosec) == ("map", "odom", 7)
    assert ros.plane(sent.transform) == pytest.approx((1.0, -2.0, 3.0))


@pytest.mark.parametrize("name", ["odom", "/", "/odom/", "/1odom", "/a//b", "/a b", "/a*"])
def test_topics_that_cannot_be_are_refused(name: str) -> None:
    with pytest.raises(BadRosName, match="full ROS name"):
        Topic(name, ODOMETRY, STRING)


@pytest.mark.parametrize("mount", ["camera", "camera=1,2,3", "camera=0,0,0,0,0,0,0", "camera=a,0,0,0,0,0,1"])
def test_mounts_that_cannot_be_are_wrong_use(mount: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["ros2", "m", "--mount", mount]) == USAGE
    assert "[bad_ros_name]" in capsys.readouterr().err


def test_options_arrive() -> None:
    options = BridgeOptions(
        odom="/o", poses=(), landmarks=("/a", "/b"), map_frame="map", space=True, letter="a", start="pose",
        keyframe=(1.0, 2.0), mounts=("c=1,2,3,0,0,0,1",), drift=(0.1, 0.2), tf="/tf", tf_raw="/r", path="/p",
        markers="/m", pose_out="/c", tolerance=0.5, smooth_s=3.0, display=2.0, imu="/i", imu_noise=(1.0, 2.0, 3.0, 4.0),
    )  # fmt: skip
    made = bridge_settings(options)
    assert (made.poses, made.landmarks, made.space, made.floors.turn_rad) == (
        ("/initialpose",),
        ("/a", "/b"),
        "space",
        0.2,
    )
    np.testing.assert_array_equal(made.mounts["c"].t, from_quaternion((1, 2, 3), (0, 0, 0, 1)).t)
    listed = bridge_settings(replace(options, landmark_lists=("/landmark",), tags=("/tags",), landmarks=()))
    assert {"/detections": DETECTIONS, "/landmark": LANDMARK_LIST, "/tags": TAGS}.items() <= listed.inputs().items()
    assert (made.smooth_s, made.raw_transforms) == (3.0, "/r")
    assert (made.pose, made.imu, made.imu_noise.accelerometer_walk) == ("/c", "/i", 4.0)
    with pytest.raises(BadRosName, match="velocities, biases or gravity"):
        bridge_settings(replace(options, letter="B"))
    with pytest.raises(BadRosName, match="--space"):
        bridge_settings(replace(options, space=False))
    with pytest.raises(BadRosName, match="one for each of --tf and --tf-raw"):
        bridge_settings(replace(options, tf_raw="/tf"))
    with pytest.raises(BadRosName, match="--smooth-s with it"):
        bridge_settings(replace(options, smooth_s=0.0))
    assert bridge_settings(replace(options, smooth_s=0.0, tf_raw=Settings().raw_transforms)).smooth_s == 0.0
    with pytest.raises(BadRosName, match="the topic of odometry ''"):
        bridge_settings(replace(options, odom=""))
    with pytest.raises(BadRosName, match=r"one type of it: here it is of nav_msgs/msg/Odometry and of .*NavSatFix"):
        bridge_settings(replace(options, fixes=("/o",)))
    with pytest.raises(BadRosName, match="here it is of geometry_msgs"):
        bridge_settings(replace(options, fixes=("/initialpose",)))
    nothing = bridge_settings(replace(options, poses=("none",), landmarks=("none",), start="odometry"))
    assert nothing.inputs().keys() == {"/o", "/i"}


@pytest.mark.parametrize("space", ["plane", "space"])
def test_a_pose_has_its_covariance_about_the_axes_of_the_map(space: str) -> None:
    """It looks 0.3 rad to the left of x: what is uncertain ahead of it is so along that way."""
    settings, key = Settings(space=space, letter="a"), symbol("a", 5)
    flat = space == "plane"
    row = [1.0, 2.0, 0.3] if flat else [1.0, 2.0, 3.0, 0.0, 0.0, np.sin(0.15), np.cos(0.15)]
    keys, kind = np.array([symbol("a", 4), key, symbol("b", 9)]), "se2" if flat else "se3"
    snapshot = Snapshot(1, 1, {kind: (keys, np.tile(row, (3, 1)))}, {kind: np.array([1, 7 * 10**9 + 5, 2])})
    assert display.last_keyframe(settings, snapshot) == key
    told = np.diag([4.0, 1.0, 0.1]) if flat else np.diag([4.0, 1.0, 2.0, 0.4, 0.1, 0.2])
    data = display.certain_pose(MESSAGES, settings, snapshot, key, told)
    read = words.PoseWithCovarianceStamped.deserialize(data)
    c, s = np.cos(0.3), np.sin(0.3)
    R = np.kron(np.eye(2), [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    wanted = R @ np.diag([4.0, 1.0, 0.0, 0.0, 0.0, 0.1] if flat else np.diag(told)) @ R.T
    np.testing.assert_allclose(np.array(read.pose.covariance).reshape(6, 6), wanted, atol=1e-12)
    assert (read.header.frame_id, read.header.stamp) == ("map", ros.stamp(7 * 10**9 + 5))
    assert ros.plane(read.pose.pose) == pytest.approx((1.0, 2.0, 0.3))
    assert display.last_keyframe(settings, Snapshot(1, 1, {}, {})) is None
