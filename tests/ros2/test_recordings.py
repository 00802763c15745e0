"""Recordings of a robot as maps: the same of each kind of file, right, and of damaged ones what can be read."""

import json
import math
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recordings
import ros
from mcap.writer import CompressionType
from rosbags.rosbag2 import StoragePlugin

from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK, USAGE
from factorbus.proto.messages import Batch
from factorbus.ros2.messages import ODOMETRY, TRANSFORMS
from factorbus.ros2.problems import BadRecording
from factorbus.ros2.recorded_drive import RecordedDrive, read_recording
from factorbus.ros2.settings import Settings

FOUND = Settings(odometry="", poses=(), landmarks=())


def bits(batch: Batch) -> list[Any]:
    columns = [(g.kind, g.fixed, g.keys.tobytes(), *(c if c is None else c.tobytes() for c in (g.values, g.stamps)))
               for g in batch.variables]  # fmt: skip
    return columns + [(g.kind, *(c.tobytes() for c in (g.keys, g.measured, g.information))) for g in batch.factors]


def same(one: RecordedDrive, other: RecordedDrive) -> bool:
    return [bits(batch) for batch in one.steps] == [bits(batch) for batch in other.steps]


def run(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, dict[str, Any], str]:
    code = main(["replay", *map(str, words), "--json"])
    told = capsys.readouterr()
    return code, json.loads(told.out) if told.out else {}, told.err


@pytest.fixture(scope="module")
def drive() -> recordings.Drive:
    return recordings.drive()


@pytest.fixture(scope="module")
def whole(drive: recordings.Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recordings.write_mcap(tmp_path_factory.mktemp("whole") / "drive.mcap", drive.said)


def test_the_same_drive_is_the_same_map_from_each_kind_of_recording(
    drive: recordings.Drive, whole: Path, tmp_path: Path
) -> None:
    reference = read_recording(whole, FOUND)
    assert reference.steps.poses == 45
    assert reference.used == {"/odom": 45, "/detections": 45}
    others = [
        recordings.write_mcap(tmp_path / "plain.mcap", drive.said, CompressionType.NONE),
        recordings.write_rosbag2(tmp_path / "sqlite", drive.said),
        recordings.write_rosbag2(tmp_path / "mcap", drive.said, StoragePlugin.MCAP),
        recordings.write_bag(tmp_path / "drive.bag", drive.said),
    ]
    for path in others:
        assert same(read_recording(path, FOUND), reference), path


def test_a_recording_is_driven_and_its_map_is_right(
    drive: recordings.Drive, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tum = tmp_path / "way.tum"
    code, document, told = run(capsys, whole, "--in-process", "--tum", tum, "--every", "11")
    assert code == OK
    assert (document["poses"], document["landmarks"], document["fixed"]) == (45, 4, ["x0"])
    assert document["read"] == {
        "dialect": "recording",
        "notes": ["odometry: /odom", "landmarks: /detections"],
        "used": {"/detections": 45, "/odom": 45},
        "left_out": {},
    }
    assert "odometry: /odom" in told
    assert all(each["ratio"] < 1.001 for each in document["against_batch"])
    rows = np.loadtxt(tum)
    assert rows[-1, 0] == pytest.approx(1_700_000_044.0)  # seconds of the recording
    assert math.dist(rows[-1, 1:3], drive.true[:2]) < 0.08 < 0.8 < math.dist(drive.told[:2], drive.true[:2])


def test_what_is_left_out_is_said_counted_and_refused_where_that_is_asked(
    drive: recordings.Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Detections in a frame that nothing places on the robot."""
    said = [each for each in drive.said if each.topic != "/tf_static"]
    path = recordings.write_mcap(tmp_path / "nowhere.mcap", said)
    made = read_recording(path, FOUND)
    assert made.left_out == {"/detections": 45}
    (note,) = [note for note in made.notes if "not used" in note]
    assert "'camera'" in note
    assert "--mount camera=x,y,z,qx,qy,qz,qw" in note
    code, _, told = run(capsys, path, "--in-process", "--strict")
    assert code == BAD_FILE
    assert "[bad_file]" in told
    placed = f"camera=0.3,0,0,0,0,{math.sin(math.pi / 4)},{math.cos(math.pi / 4)}"
    code, document, _ = run(capsys, path, "--in-process", "--strict", "--mount", placed)
    assert code == OK
    assert document["landmarks"] == 4


def test_poses_are_left_out_until_they_are_asked_for(
    drive: recordings.Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recordings.write_mcap(tmp_path / "amcl.mcap", [*drive.said[:3], recordings.amcl(), *drive.said[3:]])
    code, document, told = run(capsys, path, "--in-process")
    assert code == OK
    assert "poses left out: /amcl_pose; --pose /amcl_pose takes them" in told
    code, document, _ = run(capsys, path, "--in-process", "--pose", "/amcl_pose", "--start", "pose")
    assert code == OK
    assert document["fixed"] == []
    assert document["read"]["used"]["/amcl_pose"] == 1


def test_of_several_odometries_one_is_taken_and_said(drive: recordings.Drive, tmp_path: Path) -> None:
    wheels = [each._replace(topic="/wheels") for each in drive.said if each.topic == "/odom"]
    path = recordings.write_mcap(tmp_path / "two.mcap", [*drive.said, *wheels[:20]])
    made = read_recording(path, FOUND)
    assert "odometry: /odom (of /odom, /wheels; --odom decides)" in made.notes
    other = read_recording(path, Settings(odometry="/wheels", poses=(), landmarks=()))
    assert (made.steps.poses, other.steps.poses) == (45, 20)


@pytest.mark.parametrize(
    ("said", "settings", "wanted"),
    [
        ("tags", FOUND, "no odometry; wanted a topic of nav_msgs/msg/Odometry, .*; it has /detections"),
        ("all", Settings(odometry="/odm", poses=(), landmarks=()), "no topic /odm; wanted one of /detections, /odom"),
    ],
)
def test_a_recording_without_what_is_wanted_names_what_it_has(
    drive: recordings.Drive, tmp_path: Path, said: str, settings: Settings, wanted: str
) -> None:
    chosen = [each for each in drive.said if said == "all" or each.topic == "/detections"]
    path = recordings.write_mcap(tmp_path / "lacks.mcap", chosen)
    with pytest.raises(BadRecording, match=wanted):
        read_recording(path, settings)


def test_of_a_recording_that_was_cut_off_the_beginning_is_driven(whole: Path, tmp_path: Path) -> None:
    data, reference = whole.read_bytes(), read_recording(whole, FOUND)
    path, chance, read, refused = tmp_path / "cut.mcap", random.Random(5), 0, 0
    for cut in [0, 4, 8, 60, *sorted(chance.sample(range(100, len(data)), 60))]:
        path.write_bytes(data[:cut])
        try:
            made = read_recording(path, FOUND)
        except BadRecording:
            refused += 1
            continue
        read += 1
        assert [bits(a) for a in made.steps] == [bits(b) for b in reference.steps[: len(made.steps)]]
        assert any("no index" in note or "cut off" in note for note in made.notes)
    assert read > 30
    assert refused >= 4


@pytest.mark.parametrize("compression", list(CompressionType))
def test_of_a_chunk_that_is_cut_off_what_is_there_is_driven(
    drive: recordings.Drive, whole: Path, tmp_path: Path, compression: CompressionType
) -> None:
    """One chunk has all, so without its beginning nothing is read."""
    path, reference = tmp_path / "one.mcap", read_recording(whole, FOUND)
    (tf, *_) = [each for each in drive.said if each.type_name == TRANSFORMS]
    many = [tf._replace(topic="/other")] * 3000  # more blocks of the compression
    data = recordings.write_mcap(path, [*drive.said, *many], compression, 1 << 30).read_bytes()
    lengths = set[int]()
    for share in (0.02, 0.5, 0.6, 0.7, 0.8, 0.9):
        path.write_bytes(data[: int(share * len(data))])
        try:
            made = read_recording(path, FOUND)
        except BadRecording:
            continue
        assert [bits(a) for a in made.steps] == [bits(b) for b in reference.steps[: len(made.steps)]]
        assert any("no index" in note or "cut off" in note for note in made.notes)
        lengths.add(len(made.steps))
    assert lengths
    assert min(lengths) > 0
    path.write_bytes(data[:100])
    with pytest.raises(BadRecording, match="before its first chunk does, so no message in it is whole"):
        read_recording(path, FOUND)


def test_of_a_topic_with_two_types_the_messages_of_one_are_read(drive: recordings.Drive, tmp_path: Path) -> None:
    said = [each for each in drive.said if each.topic == "/odom"]
    (tf, *_) = [each for each in drive.said if each.type_name == TRANSFORMS]
    path = recordings.write_mcap(tmp_path / "two.mcap", [*said, tf._replace(topic="/odom")])
    path.write_bytes(path.read_bytes()[:-40])  # as a whole it would not be read by its topic
    made = read_recording(path, FOUND)
    assert made.steps.poses == 45
    assert any(
        f"1 message not used; the first: a {tf.type_name}; wanted a {ODOMETRY}" in note for note in made.notes
    ), made.notes


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_folder_whose_recorder_was_killed_has_no_metadata_and_is_driven(
    drive: recordings.Drive, whole: Path, tmp_path: Path, storage: StoragePlugin, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recordings.write_rosbag2(tmp_path / "killed", drive.said, storage)
    (path / "metadata.yaml").unlink()
    made = read_recording(path, FOUND)
    assert same(made, read_recording(whole, FOUND))
    assert any("no metadata.yaml: killed" in note for note in made.notes)
    assert run(capsys, path, "--in-process")[0] == OK
    (path / "another.db3").write_bytes(b"")
    with pytest.raises(BadRecording, match=r"2 files and no metadata.yaml; wanted .*`ros2 bag reindex`"):
        read_recording(path, FOUND)


@pytest.mark.parametrize("ending", ["mcap", "bag", "sqlite"])
def test_damage_gives_what_can_be_read_or_a_reason_and_never_ends_otherwise(
    drive: recordings.Drive, whole: Path, tmp_path: Path, ending: str
) -> None:
    if ending == "mcap":
        path = file = tmp_path / "damaged.mcap"
        path.write_bytes(whole.read_bytes())
    elif ending == "bag":
        path = file = recordings.write_bag(tmp_path / "damaged.bag", drive.said)
    else:
        path = recordings.write_rosbag2(tmp_path / "damaged", drive.said)
        (file,) = path.glob("*.db3")
    good, chance, outcomes = file.read_bytes(), random.Random(7), set[str]()
    for _ in range(60):
        data = bytearray(good)
        at, size = chance.randrange(len(data)), chance.choice([1, 4, 64, 1024])
        data[at : at + size] = chance.randbytes(len(data[at : at + size]))
        if chance.random() < 0.3:
            del data[chance.randrange(len(data)) :]
        file.write_bytes(data)
        try:
            made = read_recording(path, FOUND)
            outcomes.add("read")
            assert all(np.isfinite(group.measured).all() for batch in made.steps for group in batch.factors)
        except BadRecording:
            outcomes.add("refused")
    assert outcomes == {"read", "refused"}


@pytest.mark.parametrize("name", ["nothing.mcap", "folder.bag", "text.mcap"])
def test_what_is_no_recording_is_refused_with_a_reason(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    if name == "text.mcap":
        path.write_text("not a recording")
    elif name == "folder.bag":
        path.write_bytes(b"#ROSBAG V2.0\n")
    code, _, told = run(capsys, path, "--in-process")
    assert code == BAD_FILE
    assert "[bad_file]" in told
    assert "Traceback" not in told


@pytest.mark.parametrize("words", [["--dialect", "g2o"], ["--use-values"]])
def test_options_of_graph_files_are_wrong_use_with_a_recording(
    whole: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(capsys, whole, *words)[0] == USAGE


@pytest.mark.parametrize("words", [["--odom", "/odom"], ["--rate", "1"], ["--pose", "/p"], ["--space"]])
def test_options_of_recordings_are_wrong_use_with_a_graph_file(
    words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "two.g2o"
    path.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    code, _, told = run(capsys, path, "--in-process", *words)
    assert code == USAGE
    assert f"{words[0]} is of recordings" in told


def test_at_its_own_rate_a_recording_takes_its_time(
    drive: recordings.Drive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recordings.write_mcap(tmp_path / "short.mcap", drive.said[:20])  # ten seconds
    code, document, _ = run(capsys, path, "--in-process", "--rate", "20", "--no-settle")
    assert code == OK
    assert 0.4 <= document["seconds"] < 5.0


def test_space(whole: Path) -> None:
    made = read_recording(whole, Settings(odometry="", poses=(), landmarks=(), space="space"))
    kinds = {group.kind for batch in made.steps for group in batch.factors}
    assert kinds == {"between_se3", "landmark_se3"}


def test_bytes_that_are_no_message_are_counted(drive: recordings.Drive, tmp_path: Path) -> None:
    class Broken:
        def serialize(self) -> bytes:
            return b"\x00\x01\x00\x00" + b"\xff" * 9

    said = [*drive.said[:10], recordings.Said("/odom", ODOMETRY, recordings.START_NS + 5, Broken()), *drive.said[10:]]
    made = read_recording(recordings.write_mcap(tmp_path / "bytes.mcap", said), FOUND)
    assert made.left_out == {"/odom": 1}
    assert made.steps.poses == 45


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        (replace(FOUND, odometry="/detections"), "/detections is of vision_msgs/msg/Detection3DArray"),
        (replace(FOUND, poses=("/odom",)), "/odom is of nav_msgs/msg/Odometry"),
        (replace(FOUND, landmarks=("/odom",)), "there is /detections"),
    ],
)
def test_a_topic_of_another_type_is_refused(whole: Path, settings: Settings, found: str) -> None:
    with pytest.raises(BadRecording) as refused:
        read_recording(whole, settings)
    assert found in str(refused.value)


def test_of_several_robots_one_is_driven_with_what_is_its_own(drive: recordings.Drive, tmp_path: Path) -> None:
    said = [each._replace(topic=f"/{robot}{each.topic}") for each in drive.said for robot in ("one", "two")]
    made = read_recording(recordings.write_mcap(tmp_path / "robots.mcap", said), replace(FOUND, odometry="/two/odom"))
    assert made.used == {"/two/odom": 45, "/two/detections": 45}, "placed by its own tf_static"
    assert "landmarks: /two/detections" in made.notes
    (note,) = [note for note in made.notes if "another robot" in note]
    assert "--landmarks /one/detections takes them" in note
    assert not made.left_out


def test_without_stamps_nothing_is_made_of_it(drive: recordings.Drive, tmp_path: Path) -> None:
    for each in drive.said:
        if each.topic != "/tf_static":
            each.message.header.stamp = ros.stamp(0)
    try:
        path = recordings.write_mcap(tmp_path / "stampless.mcap", drive.said)
    finally:
        for each in drive.said:
            if each.topic != "/tf_static":
                each.message.header.stamp = ros.stamp(each.ns)
    with pytest.raises(BadRecording, match="a stamp of 0"):
        read_recording(path, FOUND)


def test_observations_in_a_gap_of_odometry_are_not_used(drive: recordings.Drive, tmp_path: Path) -> None:
    """Where between the two odometries the robot was nobody knows."""
    late = recordings.START_NS + 10**15
    odometry = [n for n, each in enumerate(drive.said) if each.topic == "/odom"]
    said = [each for n, each in enumerate(drive.said) if n not in odometry[10:]]
    end = drive.said[odometry[10]]
    said += [end._replace(ns=ns, message=ros.odometry(ns, (5.0, 0.0, 0.0))) for ns in (late, late + 10**9)]
    made = read_recording(recordings.write_mcap(tmp_path / "future.mcap", said), FOUND)
    assert made.left_out["/detections"] > 30
    notes = [note for note in made.notes if note.startswith("/detections")]
    assert len(notes) == 1
    assert "a gap of" in notes[0]
    assert any("no odometry for 1e+06 s, or a clock that was set ahead" in note for note in made.notes)


def test_poses_that_are_elsewhere_than_odometry_begins_are_said(drive: recordings.Drive, tmp_path: Path) -> None:
    path = recordings.write_mcap(tmp_path / "amcl.mcap", [*drive.said[:5], recordings.amcl(), *drive.said[5:]])
    made = read_recording(path, replace(FOUND, poses=("/amcl_pose",)))
    (note,) = [note for note in made.notes if "--start pose" in note]
    assert note.startswith("/amcl_pose: it says that the robot is 12.4 m")
    begun = read_recording(path, replace(FOUND, poses=("/amcl_pose",), start="pose"))
    assert not any("--start pose" in note for note in begun.notes)


def test_the_letter_of_landmarks_is_not_a_robots(whole: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, _, told = run(capsys, whole, "--in-process", "--letter", "l")
    assert code != OK
    assert "another one: this is that of landmarks" in told
