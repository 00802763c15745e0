"""Recordings as people have them: of two robots, in parts, without what is left out on purpose; and what is said."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import full_drive
import pytest
import recordings
from full_drive import FIX, GRAPH, IMU, ODOM
from mcap.writer import Writer
from rosbags.rosbag2 import StoragePlugin
from test_recordings import FOUND, bits, run, same

from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK, USAGE
from factorbus.ros2.options import RobotOptions
from factorbus.ros2.problems import BadRecording, BadRosName
from factorbus.ros2.recorded_drive import read_recording
from factorbus.ros2.settings import robot_settings

OPTIONS = RobotOptions(
    odom="", poses=(), landmarks=(), map_frame="map", space=False, letter="x", start="odometry", keyframe=(0.5, 0.35),
    mounts=(), drift=(0.02, 0.02),
)  # fmt: skip
DRIVE = recordings.drive()


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return full_drive.write(tmp_path_factory.mktemp("drive") / "drive.mcap", full_drive.full_drive(20))


def test_of_two_robots_one_has_its_own_graph_its_own_receiver_and_its_own_imu(tmp_path: Path) -> None:
    """Both graphs have a robot 0, and both receivers a topic that ends in fix: the other's made a wrong map of it."""
    drives = {f"/{name}": full_drive.full_drive(30, seed) for name, seed in (("one", 1), ("two", 7))}
    both = full_drive.write_robots(tmp_path / "both.mcap", drives)
    for name, other in (("/one", "/two"), ("/two", "/one")):
        alone = read_recording(full_drive.write(tmp_path / f"{name[1:]}.mcap", drives[name]), FOUND)
        made = read_recording(both, replace(FOUND, odometry=name + ODOM))
        assert same(made, alone)
        assert made.used == {name + topic: count for topic, count in alone.used.items()}
        for text in (
            f"closures: {name}{GRAPH} (pose_graph_tools_msgs/msg/PoseGraph)",
            f"closures of another robot left out: {other}{GRAPH}; --pose-graph {other}{GRAPH} takes them",
            f"GNSS: {name}{FIX}",
            f"GNSS of another robot left out: {other}{FIX}; --fix {other}{FIX} takes them",
            f"IMU left out: {name}{IMU}; --space --imu {name}{IMU} takes its raw samples, "
            "where odometry was not made of them already",
        ):
            assert text in made.notes, text


def test_none_in_the_place_of_a_topic_reads_none(path: Path) -> None:
    whole = read_recording(path, robot_settings(OPTIONS))
    without = read_recording(path, robot_settings(replace(OPTIONS, fixes=("none",), pose_graphs=("none",))))
    assert {ODOM, FIX, GRAPH} == whole.used.keys()
    assert without.used == {ODOM: whole.used[ODOM]}
    assert not any("GNSS" in note or "closures" in note for note in without.notes)
    seen = read_recording(path, robot_settings(replace(OPTIONS, fixes=("none",))))
    assert seen.used.keys() == {ODOM, GRAPH}


@pytest.mark.parametrize(
    ("options", "wanted"),
    [
        (replace(OPTIONS, fixes=("none", "/fix")), "the topic 'none' cannot be; wanted topics, or none alone"),
        (replace(OPTIONS, poses=("none",), start="pose"), "--start pose waits for the first"),
        (replace(OPTIONS, imu_noise=(1e-3, 1e-2, 1e-5, 1e-4)), "--imu with the topic of the IMU that it is of"),
    ],
)
def test_options_that_cannot_be_together_are_refused(options: RobotOptions, wanted: str) -> None:
    with pytest.raises(BadRosName) as refused:
        robot_settings(options)
    assert wanted in str(refused.value)


def test_to_begin_with_a_pose_one_has_to_be_read(path: Path, tmp_path: Path) -> None:
    with pytest.raises(
        BadRecording, match=r"--start pose, and no poses are read; wanted a topic of .*, and it has none"
    ):
        read_recording(path, replace(FOUND, start="pose"))
    seen = recordings.write_mcap(tmp_path / "amcl.mcap", [*DRIVE.said[:3], recordings.amcl(), *DRIVE.said[3:]])
    with pytest.raises(BadRecording, match="wanted --pose with one of /amcl_pose"):
        read_recording(seen, replace(FOUND, start="pose"))


def test_what_the_plane_leaves_out_is_said_where_it_is_not_small(path: Path) -> None:
    (note,) = [note for note in read_recording(path, FOUND).notes if "the plane" in note]
    assert note.startswith("/odom: odometry leans by 0.1")
    assert note.endswith("height, roll and pitch are left out in the plane, --space has them (1 time)")
    assert not any("the plane" in note for note in read_recording(path, replace(FOUND, space="space")).notes)


def parts(folder: Path, cuts: tuple[int, ...] = (30, 60), name: str = "drive") -> Path:
    """The square drive as a recorder leaves it that was told to begin a new file now and then, and was killed."""
    folder.mkdir()
    ends = [0, *cuts, len(DRIVE.said)]
    for number, (begin, end) in enumerate(pairwise(ends)):
        recordings.write_mcap(folder / f"{name}_{number}.mcap", DRIVE.said[begin:end])
    return folder


def test_the_files_of_a_recorder_that_was_killed_are_read_in_their_order(tmp_path: Path) -> None:
    whole = read_recording(recordings.write_mcap(tmp_path / "drive.mcap", DRIVE.said), FOUND)
    folder = parts(tmp_path / "drive", tuple(range(8, 88, 8)))  # ten and eleven come after nine
    made = read_recording(folder, FOUND)
    assert same(made, whole)
    assert any(note.startswith("no metadata.yaml: drive_0.mcap, drive_1.mcap, ") for note in made.notes)
    last = folder / "drive_10.mcap"
    last.write_bytes(last.read_bytes()[:-60])
    cut = read_recording(folder, FOUND)
    assert 40 < len(cut.steps) <= len(whole.steps)
    assert [bits(a) for a in cut.steps] == [bits(b) for b in whole.steps[: len(cut.steps)]]
    last.write_bytes(b"\x89MCAP0\r\n")
    gone = read_recording(folder, FOUND)
    assert any(
        note.startswith("drive_10.mcap is left out: its 8 bytes end before its first chunk") for note in gone.notes
    )
    (folder / "drive_4.mcap").unlink()
    assert any("drive_3.mcap, drive_5.mcap" in note for note in read_recording(folder, FOUND).notes)


def test_the_files_of_several_recordings_are_not_taken_for_one(tmp_path: Path) -> None:
    folder = parts(tmp_path / "drive")
    recordings.write_mcap(folder / "other_0.mcap", DRIVE.said)
    with pytest.raises(BadRecording, match=r"4 files and no metadata.yaml; wanted .* the files of one recording"):
        read_recording(folder, FOUND)


def test_a_folder_whose_file_was_cut_off_is_driven_as_far_as_it_can_be_read(tmp_path: Path) -> None:
    folder = recordings.write_rosbag2(tmp_path / "drive", DRIVE.said, StoragePlugin.MCAP)
    whole = read_recording(folder, FOUND)
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-200])
    made = read_recording(folder, FOUND)
    assert [bits(a) for a in made.steps] == [bits(b) for b in whole.steps[: len(made.steps)]]
    assert len(made.steps) > 30
    assert any("it cannot be read as a whole" in note for note in made.notes)


def test_one_file_of_several_is_read_and_that_is_said(tmp_path: Path) -> None:
    folder = parts(tmp_path / "drive")
    written = recordings.write_rosbag2(tmp_path / "written", DRIVE.said, StoragePlugin.MCAP)
    shutil.copy(written / "metadata.yaml", folder)
    made = read_recording(folder / "drive_1.mcap", FOUND)
    assert f"one of the 3 files of a recording; all of it is {folder}" in made.notes
    assert made.steps.poses < 30


def test_a_file_of_a_folder_stands_for_it_or_names_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = recordings.write_rosbag2(tmp_path / "drive", DRIVE.said)
    code, document, _ = run(capsys, folder / "metadata.yaml", "--in-process")
    assert (code, document["poses"]) == (OK, 45)
    compressed = folder / "drive.db3.zstd"
    compressed.write_bytes(b"\x28\xb5\x2f\xfd\x00")
    code, _, told = run(capsys, compressed, "--in-process")
    assert code == BAD_FILE
    assert f"a file that ros2 bag has compressed; wanted its folder, {folder}" in " ".join(told.split())


def test_commands_about_graphs_say_how_a_recording_becomes_one(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(path.parent)
    assert main(["convert", "drive.mcap", str(tmp_path / "out.g2o")]) == BAD_FILE
    told = " ".join(capsys.readouterr().err.split())
    assert "a robot's recording; wanted a graph: factorbus replay drive.mcap --in-process --out map.g2o" in told
    (path.parent / "my drive.mcap").symlink_to(path)
    assert main(["convert", "my drive.mcap", str(tmp_path / "out.g2o")]) == BAD_FILE
    assert "factorbus replay 'my drive.mcap' --in-process" in " ".join(capsys.readouterr().err.split())
    assert main(["plot", "map", "drive.mcap", "--out", str(tmp_path / "map.png")]) == BAD_FILE
    assert "a robot's recording" in capsys.readouterr().err


def test_the_frame_of_gnss_is_no_pose_of_what_is_solved(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = read_recording(path, FOUND).steps.poses
    assert main(["solve", str(path)]) == OK
    assert f"{poses} poses" in capsys.readouterr().out


PARAMETERS = """
/**:
  ros__parameters:
    odom: /odom
    keyframe: [2, 1]
    fix: [none]
    use_sim_time: true
    smooth_s: 2.0  # from here on the bridge's alone
    domain: 3
    map: hall
    connect: tcp/127.0.0.1:1
"""


def test_the_parameters_of_the_robots_bridge_are_read(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (file := tmp_path / "robot.yaml").write_text(PARAMETERS)
    code, document, _ = run(capsys, path, "--in-process", "--params-file", file)
    asked = replace(OPTIONS, odom="/odom", fixes=("none",), keyframe=(2.0, 1.0))
    assert (code, document["poses"]) == (OK, read_recording(path, robot_settings(asked)).steps.poses)
    assert document["read"]["used"].keys() == {ODOM, GRAPH}
    code, document, _ = run(capsys, path, "--in-process", "--params-file", file, "--keyframe", "0.5", "0.35")
    assert document["poses"] == read_recording(path, FOUND).steps.poses
    delivered = Path(__file__).parents[2] / "deploy" / "ros2" / "robot.yaml"
    assert run(capsys, path, "--in-process", "--params-file", delivered)[1]["poses"] == document["poses"]
    (tmp_path / "graph.g2o").write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    assert main(["replay", str(tmp_path / "graph.g2o"), "--in-process", "--params-file", str(file)]) == USAGE
    assert "--params-file is of recordings" in capsys.readouterr().err
    file.write_text(PARAMETERS.replace("smooth_s", "smoth_s"))
    assert run(capsys, path, "--in-process", "--params-file", file)[0] == BAD_FILE


def mcap(path: Path, profile: str, ros1: bool, encoding: str = "") -> Path:
    """The drive by the mcap library, as `mcap convert` makes of a bag of ROS 1, or as another recorder writes it."""
    words = full_drive.RosWords(ros1)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile, "tests")
        channels: dict[str, int] = {}
        for topic, ns, message in words.said(full_drive.full_drive(20)):
            name = full_drive.TYPES[topic]
            if topic not in channels:
                text, _ = words.store.generate_msgdef(name, ros_version=1 if ros1 else 2)
                short = name.replace("/msg/", "/") if ros1 else name
                schema = writer.register_schema(short, "ros1msg" if ros1 else "ros2msg", text.encode())
                channels[topic] = writer.register_channel(topic, encoding or ("ros1" if ros1 else "cdr"), schema)
            writer.add_message(channels[topic], ns, words.serialize(topic, message), ns)
        writer.finish()
    return path


@pytest.mark.parametrize(("profile", "ros1"), [("ros1", True), ("", False), ("other", False)])
def test_an_mcap_of_another_recorder_or_of_ros_1_is_the_same_map(
    profile: str, ros1: bool, path: Path, tmp_path: Path
) -> None:
    whole, file = read_recording(path, FOUND), mcap(tmp_path / "other.mcap", profile, ros1)
    made = read_recording(file, FOUND)
    assert same(made, whole)
    assert made.notes == whole.notes, "nothing of it is missing"
    file.write_bytes(file.read_bytes()[:-400])
    cut = read_recording(file, FOUND)
    assert [bits(a) for a in cut.steps] == [bits(b) for b in whole.steps[: len(cut.steps)]]
    assert any("cut off or damaged" in note for note in cut.notes)


def test_an_mcap_with_nothing_of_ros_says_what_it_has(tmp_path: Path) -> None:
    with pytest.raises(
        BadRecording, match="no topic of ROS in it, but /gps/fix, /imu/data_raw, /kimera/pose_graph, /odom;"
    ):
        read_recording(mcap(tmp_path / "proto.mcap", "", False, "protobuf"), FOUND)


def test_a_slash_before_the_name_of_a_frame_makes_no_other_one(tmp_path: Path) -> None:
    """As drivers and bags of ROS 1 have it: a mount was not found, and the IMU and landmarks were left out."""
    said = recordings.drive().said
    whole = read_recording(recordings.write_mcap(tmp_path / "plain.mcap", said), FOUND)
    for each in said:
        if each.topic == "/odom":
            each.message.child_frame_id = "/base_link"
            each.message.header.frame_id = "/odom"
        elif each.topic == "/detections":
            each.message.header.frame_id = "/camera"
            for seen in each.message.detections:
                seen.header.frame_id = "/camera"
    made = read_recording(recordings.write_mcap(tmp_path / "slash.mcap", said), FOUND)
    assert same(made, whole)
    assert made.notes == whole.notes
    asked = robot_settings(replace(OPTIONS, mounts=("/camera=0.3,0,0,0,0,0.70710678118654752,0.70710678118654752",)))
    without = recordings.write_mcap(tmp_path / "mounted.mcap", [each for each in said if each.topic != "/tf_static"])
    assert not read_recording(without, asked).left_out
