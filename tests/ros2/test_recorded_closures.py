"""Recordings with a front end's graph and GNSS: the map is that of the same graph inserted directly."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
import ros
import survey
from recordings import Said
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from factorbus.cli.driving.local import LocalMap
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK
from factorbus.proto.symbols import symbol
from factorbus.ros2.messages import LINK, MAP_GRAPH, POSE_GRAPH
from factorbus.ros2.problems import BadRecording
from factorbus.ros2.recorded_drive import RecordedDrive, read_recording
from factorbus.ros2.settings import Settings

FOUND = Settings(odometry="", poses=(), landmarks=())
MADE = survey.survey()


def solved(batches: Any) -> tuple[float, dict[int, np.ndarray]]:
    """χ² and the poses of the robot, converged."""
    target = LocalMap("auto")
    for batch in batches:
        target.send(batch)
    target.settle()
    groups = [group for group in target.estimate() if group.kind == "se2" and group.values is not None]
    values = {int(key): row for g in groups for key, row in zip(g.keys, g.values, strict=True)}  # type: ignore[arg-type]
    return target.chi2(), values


@pytest.fixture(scope="module")
def direct() -> tuple[float, dict[int, np.ndarray]]:
    return solved([survey.drafted(MADE).batch()])


def recorded(path: Path, messages: list[Said]) -> RecordedDrive:
    return read_recording(survey.write(path, messages), FOUND)


@pytest.mark.parametrize("graph", [POSE_GRAPH, MAP_GRAPH, LINK])
def test_odometry_closures_and_gnss_are_the_same_map_as_the_graph_inserted_directly(
    graph: str, direct: tuple[float, dict[int, np.ndarray]], tmp_path: Path
) -> None:
    made = recorded(tmp_path / "survey.mcap", survey.said(MADE, graph))
    assert made.steps.poses == survey.COUNT
    assert not made.left_out
    chi2, values = solved(made.steps)
    assert chi2 == pytest.approx(direct[0], rel=1e-6)
    assert values.keys() == direct[1].keys()
    for key, row in direct[1].items():
        tolerance = 1e-5 if key >> 56 == ord("x") else 1e-4
        np.testing.assert_allclose(values[key], row, atol=tolerance)
    off = [math.dist(values[symbol("x", n)][:2], MADE.true[n][:2]) for n in range(survey.COUNT)]
    told = [math.dist(MADE.told[n][:2], MADE.true[n][:2]) for n in range(survey.COUNT)]
    assert max(off) < 0.5 < 2.0 < max(told)
    assert values[symbol("f", 0)][2] == pytest.approx(survey.TURN, abs=0.05)


def test_topics_are_found_by_their_types_and_what_was_done_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = survey.write(tmp_path / "survey.mcap", survey.said(MADE))
    tum = tmp_path / "way.tum"
    assert main(["replay", str(path), "--in-process", "--json", "--tum", str(tum)]) == OK
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert (document["poses"], document["landmarks"]) == (survey.COUNT, 0)
    assert document["written"] == [str(tum)], "the frame of GNSS is no robot"
    assert len(tum.read_text().splitlines()) == survey.COUNT
    assert document["read"]["used"] == {
        "/odom": survey.COUNT, "/gps/fix": survey.COUNT, "/kimera/pose_graph": survey.COUNT
    }  # fmt: skip
    said = " ".join(told.err.split())
    for text in (
        "odometry: /odom",
        "closures: /kimera/pose_graph (pose_graph_tools_msgs/msg/PoseGraph)",
        "GNSS: /gps/fix",
        "/gps/fix: the origin of GNSS is latitude 48.09",
        "GNSS's frame f0 by",
        "/kimera/pose_graph: its edges of odometry are left out",
    ):
        assert text in said, text


def test_without_closures_and_fixes_it_is_the_graph_without_them(tmp_path: Path) -> None:
    for name, closures, fixes in (("closures", True, False), ("fixes", False, True)):
        messages = survey.said(MADE, POSE_GRAPH if closures else "", fixes)
        chi2, values = solved(recorded(tmp_path / f"{name}.mcap", messages).steps)
        wanted = solved([survey.drafted(MADE, closures, fixes).batch()])
        assert chi2 == pytest.approx(wanted[0], rel=1e-6)
        np.testing.assert_allclose([values[k] for k in wanted[1] if k >> 56 == ord("x")],
                                   [row for k, row in wanted[1].items() if k >> 56 == ord("x")], atol=1e-5)  # fmt: skip


def test_a_receiver_is_chosen_before_what_a_filter_makes_of_it(tmp_path: Path) -> None:
    messages = survey.said(MADE)[:60]
    filtered = [each._replace(topic="/gps/filtered") for each in messages if each.topic == "/gps/fix"]
    twice = sorted([*messages, *filtered], key=lambda each: each.ns)
    made = recorded(tmp_path / "two.mcap", twice)
    assert "GNSS: /gps/fix (of /gps/filtered, /gps/fix; --fix decides)" in made.notes
    assert "/gps/filtered" not in made.used


def test_what_still_waits_at_the_end_is_said(tmp_path: Path) -> None:
    """Three poses: far too few metres to see north; and a closure to a node that was never named."""
    messages = survey.said(MADE)[:10]
    late = ros.pose_graph(survey.at(2), {}, [(1, 99, 1, (0.0, 0.0, 0.0))])
    made = recorded(tmp_path / "short.mcap", [*messages, Said("/kimera/pose_graph", POSE_GRAPH, survey.at(2), late)])
    (waits,) = [note for note in made.notes if "still waits for a node" in note]
    assert "node 99 of robot 0" in waits
    assert any(note.startswith("/gps/fix: 3 fixes left out: the robot has moved") for note in made.notes)


def test_an_imu_is_named_as_not_used(tmp_path: Path) -> None:
    messages = survey.said(MADE)[:20]
    said = [*messages, Said("/imu/data", "sensor_msgs/msg/Imu", survey.at(1), messages[0].message)]
    made = recorded(tmp_path / "imu.mcap", said)
    takes = "--space --imu /imu/data takes its raw samples"
    assert f"IMU left out: /imu/data; {takes}, where odometry was not made of them already" in made.notes


def test_a_topic_of_another_type_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = survey.write(tmp_path / "survey.mcap", survey.said(MADE)[:20])
    code = main(["replay", str(path), "--in-process", "--pose-graph", "/gps/fix"])
    assert code == BAD_FILE
    refused = "/gps/fix is of sensor_msgs/msg/NavSatFix; wanted a topic of pose_graph_tools_msgs/msg/PoseGraph"
    assert refused in " ".join(capsys.readouterr().err.split())
    with pytest.raises(BadRecording, match="no topic /graph"):
        read_recording(path, Settings(odometry="/odom", poses=(), landmarks=(), pose_graphs=("/graph",)))


def test_it_is_the_same_from_each_kind_of_recording(tmp_path: Path) -> None:
    messages = survey.said(MADE)
    reference = recorded(tmp_path / "survey.mcap", messages)
    other = read_recording(recordings.write_rosbag2(tmp_path / "survey", messages), FOUND)
    for one, two in zip(reference.steps, other.steps, strict=True):
        assert [g.measured.tobytes() for g in one.factors] == [g.measured.tobytes() for g in two.factors]


@pytest.mark.parametrize("graph", [POSE_GRAPH, MAP_GRAPH])
def test_graphs_of_ros_1_are_read_by_their_former_names(graph: str, tmp_path: Path) -> None:
    """The first generation of PoseGraph has no robots, and RTAB-Map's names were in camel case."""
    odometry = survey.said(MADE, "", False)[1:10]
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, text in FORMER.items():
        store.register(get_types_from_msg(text, name))
    types = store.types

    def header(n: int) -> Any:
        return types["std_msgs/msg/Header"](0, types["builtin_interfaces/msg/Time"](survey.at(n) // 10**9, 0), "map")

    vector = types["geometry_msgs/msg/Vector3"](0.5, 0.25, 0.0)
    place = types["geometry_msgs/msg/Point"](0.5, 0.25, 0.0), types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    pose = types["geometry_msgs/msg/Pose"](*place)
    covariance = np.diag(np.full(6, 0.01)).ravel()
    former = {POSE_GRAPH: "pose_graph_tools/msg/PoseGraph", MAP_GRAPH: "rtabmap_ros/msg/MapGraph"}[graph]
    with Writer(tmp_path / "drive.bag") as writer:
        driven = writer.add_connection("/odom", odometry[0].type_name, typestore=store)
        graphs = writer.add_connection("/graph", former, typestore=store)
        for n, each in enumerate(odometry):
            read = recordings.STORE.read("/odom", each.type_name, each.cdr)
            made = recordings._ros1(store, each.type_name, read)
            writer.write(driven, each.ns, store.serialize_ros1(made, each.type_name))
            if graph == POSE_GRAPH:
                node = types["pose_graph_tools/msg/PoseGraphNode"](header(n), n, pose)
                edge = types["pose_graph_tools/msg/PoseGraphEdge"](header(n), 1, n, 1, pose, covariance)
                message = types[former](header(n), [node], [edge] if n == 7 else [])
            else:
                there = types["geometry_msgs/msg/Transform"](vector, place[1])
                link = types["rtabmap_ros/msg/Link"](2, n + 1, 1, there, np.diag(np.full(6, 100.0)).ravel())
                numbers = np.arange(1, n + 2, dtype=np.int32)
                message = types[former](header(n), there, numbers, [pose] * (n + 1), [link] if n >= 7 else [])
            writer.write(graphs, each.ns + 1, store.serialize_ros1(message, former))
    made = read_recording(tmp_path / "drive.bag", FOUND)
    assert any(note.startswith("closures: /graph") for note in made.notes)
    groups = [g for batch in made.steps for g in batch.factors if g.kind == "between_se2"]
    pairs = {tuple(keys): row for g in groups for keys, row in zip(g.keys.tolist(), g.measured, strict=True)}
    np.testing.assert_allclose(pairs[symbol("x", 1), symbol("x", 7)], [0.5, 0.25, 0.0])


FORMER = {
    "pose_graph_tools/msg/PoseGraphNode": "std_msgs/Header header\nuint64 key\ngeometry_msgs/Pose pose",
    "pose_graph_tools/msg/PoseGraphEdge": (
        "std_msgs/Header header\nuint64 key_from\nuint64 key_to\nint32 type\ngeometry_msgs/Pose pose\n"
        "float64[36] covariance"
    ),
    "pose_graph_tools/msg/PoseGraph": (
        "std_msgs/Header header\npose_graph_tools/PoseGraphNode[] nodes\npose_graph_tools/PoseGraphEdge[] edges"
    ),
    "rtabmap_ros/msg/Link": (
        "int32 fromId\nint32 toId\nint32 type\ngeometry_msgs/Transform transform\nfloat64[36] information"
    ),
    "rtabmap_ros/msg/MapGraph": (
        "std_msgs/Header header\ngeometry_msgs/Transform mapToOdom\nint32[] posesId\ngeometry_msgs/Pose[] poses\n"
        "rtabmap_ros/Link[] links"
    ),
}
