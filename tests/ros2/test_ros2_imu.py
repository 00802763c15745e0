"""Raw samples of an IMU in a robot's messages: the factors that a draft of the same drive has, and what goes wrong."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import imu_drive
import numpy as np
import pytest
import recordings
import ros
import words
from imu_drive import NOISE, at
from numpy.testing import assert_allclose
from recordings import Said
from test_ros2_readme import BLOCKS

from factorbus.cli.main import main
from factorbus.cli.output.exits import OK
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import format_symbol, symbol
from factorbus.ros2.front_end import FrontEnd
from factorbus.ros2.geometry import from_quaternion
from factorbus.ros2.messages import IMU, ODOMETRY, Messages
from factorbus.ros2.problems import BadRosMessage
from factorbus.ros2.recorded_drive import read_recording
from factorbus.ros2.settings import Settings
from factorbus.solver import Options, Solver

MESSAGES = Messages("jazzy")
MOUNTS = {"imu_link": from_quaternion(imu_drive.MOUNT[:3].tolist(), imu_drive.MOUNT[3:].tolist())}
SETTINGS = Settings(
    odometry="/odom", poses=(), landmarks=(), space="space", imu="/imu/data_raw", imu_noise=NOISE, mounts=MOUNTS
)


@pytest.fixture(scope="module")
def drive() -> imu_drive.ImuDrive:
    return imu_drive.imu_drive()


def feed(said: list[Said], settings: Settings = SETTINGS) -> tuple[FrontEnd, list[Batch], list[BadRosMessage]]:
    """(the front end, what it inserts, what it refuses), as the bridge hears it."""
    made, batches, refused = FrontEnd(settings, 0, (), False), list[Batch](), list[BadRosMessage]()
    for each in said:
        if each.topic == "/tf_static":
            continue
        try:
            draft = made.take(each.topic, each.type_name, MESSAGES.read(each.topic, each.type_name, each.cdr))
        except BadRosMessage as bad:
            refused.append(bad)
            continue
        if draft is not None:
            batches.append(draft.batch())
    return made, batches, refused + made.refused


def columns(batches: list[Batch]) -> dict[tuple[str, ...], Any]:
    """All variables and factors by their keys."""
    found: dict[tuple[str, ...], Any] = {}
    for batch in batches:
        for group in batch.variables:
            for n, key in enumerate(group.keys.tolist()):
                value = None if group.values is None or not np.isfinite(group.values[n]).all() else group.values[n]
                found[group.kind, format_symbol(key)] = value
        for factors in batch.factors:
            for n, keys in enumerate(factors.keys.tolist()):
                row = np.append(factors.measured[n], factors.information[n])
                found[factors.kind, *map(format_symbol, keys)] = row
    return found


def assert_same(one: list[Batch], other: list[Batch]) -> None:
    mine, theirs = columns(one), columns(other)
    assert mine.keys() == theirs.keys()
    for name, row in mine.items():
        if row is None or theirs[name] is None:
            assert row is theirs[name], name
        else:
            assert_allclose(row, theirs[name], rtol=1e-7, atol=1e-9, err_msg=str(name))


def inertial(batches: list[Batch]) -> list[tuple[str, str]]:
    """The poses that factors of the IMU join."""
    names = [name for batch in batches for name in columns([batch])]
    return [(name[1], name[4]) for name in names if name[0].startswith("imu")]


@pytest.mark.parametrize("late_s", [0.0, 0.3])
def test_a_drive_as_messages_is_the_graph_that_a_draft_of_it_has(drive: imu_drive.ImuDrive, late_s: float) -> None:
    made, batches, refused = feed(imu_drive.said(drive, late_s))
    assert not refused
    assert_same(batches, [imu_drive.drafted(drive).batch()])
    (remark,) = {text for _, text in made.remarks}
    assert remark == (
        "the IMU begins at x0, where the robot stands still: the map's z axis leans 10.3° from the vertical"
    )


def test_a_recording_of_it_is_the_same_and_its_map_is_right(
    drive: imu_drive.ImuDrive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = recordings.write_mcap(tmp_path / "imu.mcap", imu_drive.said(drive))
    asked = replace(SETTINGS, mounts={})  # by /tf_static
    made = read_recording(path, asked)
    wanted = imu_drive.drafted(drive).batch()
    assert_same(list(made.steps), [wanted])
    assert made.used["/imu/data_raw"] == len(drive.imu)
    solver = Solver(Options())
    for batch in made.steps:
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    values = {int(key): row for g in solver.estimate() for key, row in zip(g.keys, g.values, strict=True)}
    gravity = values[symbol("G", 0)]
    down = imu_drive.rotation_of(imu_drive.LEANING) @ np.array([0.0, 0.0, -imu_drive.GRAVITY])
    assert np.linalg.norm(gravity - down) < 0.3
    assert np.abs(values[symbol("B", 0)][:3] - drive.bias[:3]).max() < 2e-3
    noise = [f"{each:g}" for each in (1e-3, 1e-2, 1e-5, 1e-4)]
    words = ["replay", str(path), "--in-process", "--space", "--imu", "/imu/data_raw", "--imu-noise", *noise, "--json"]
    assert main(words) == OK
    assert '"poses": ' in capsys.readouterr().out


def test_samples_that_cannot_be_are_refused_and_the_map_is_the_same(drive: imu_drive.ImuDrive) -> None:
    said = imu_drive.said(drive)
    at_imu = [n for n, each in enumerate(said) if each.topic == "/imu/data_raw"]
    n = at_imu[50]
    ns = said[n].ns
    bad = [
        ros.imu(ns, [0.0] * 6),  # twice
        ros.imu(ns - 10**9, [0.0] * 6),  # out of order
        ros.imu(ns + 1, [math.nan] + [0.0] * 5),
        ros.imu(ns + 1, [0.0] * 5 + [1e300]),
        ros.imu(ns + 1, [0.0] * 6, "other_imu"),
    ]
    silent = ros.imu(ns + 1, [0.0] * 6)
    silent.linear_acceleration_covariance = [-1.0] + [0.0] * 8
    broken = [*said[: n + 1], *(Said("/imu/data_raw", IMU, ns, each) for each in (*bad, silent)), *said[n + 1 :]]
    _, batches, refused = feed(broken)
    assert_same(batches, [imu_drive.drafted(drive).batch()])
    texts = [str(each) for each in refused]
    wanted = ("twice", "one after the last", "nan", "finite ones", "'imu_link' as before", "without acceleration")
    assert len(texts) == len(wanted)
    for text, part in zip(texts, wanted, strict=True):
        assert part in text


def test_over_a_gap_no_factor_leads_and_the_bias_walks_on(drive: imu_drive.ImuDrive) -> None:
    frames = list(imu_drive.keyframes(drive))
    begin, end = frames[4][0] + 0.05, frames[5][0] + 0.05
    said = [e for e in imu_drive.said(drive) if e.topic != "/imu/data_raw" or not at(begin) < e.ns < at(end)]
    made, batches, refused = feed(said)
    assert not refused
    count = len(frames)
    joined = [(f"x{n}", f"x{n + 1}") for n in range(count - 1) if n not in (4, 5)]
    assert inertial(batches) == joined
    assert [name[1:] for name in columns(batches) if name[0].startswith("linear") and "B6" in name] == [("B4", "B6")]
    assert ("vector3", "V6") in columns(batches)
    assert [text for _, text in made.remarks if "a gap" in text] == 2 * [
        "a gap in its samples, of more than 10 of their intervals: keyframes on both sides are not joined by the IMU"
    ]


def test_a_clock_that_is_set_back_parts_the_chain_and_it_goes_on(drive: imu_drive.ImuDrive) -> None:
    """All stamps from the middle on are 100 s earlier."""
    made, back = drive, 100 * 10**9
    said, middle = imu_drive.said(made), at(made.odometry[len(made.odometry) // 2][0])
    for each in said:
        if each.topic != "/tf_static" and each.ns >= middle:
            each.message.header.stamp = ros.stamp(each.ns - back)
    front_end, batches, refused = feed(said)
    texts = [text for _, text in front_end.remarks]
    assert any(text.startswith("the clock was set back by ") for text in texts)
    assert any("odometry goes on by the new one" in text for text in texts)
    assert len([bad for bad in refused if "/imu" in str(bad)]) == 2, "until it is clear that the clock was set"
    found = inertial(batches)
    assert len(found) > len(list(imu_drive.keyframes(made))) - 5
    assert len({first for first, _ in found}) == len(found)


def test_the_first_velocity_of_a_robot_that_moves_is_that_of_odometry(drive: imu_drive.ImuDrive) -> None:
    begin = 8.0  # by then it drives
    said = [each for each in imu_drive.said(drive) if each.topic == "/tf_static" or each.ns >= at(begin)]
    made, batches, _ = feed(said)
    assert any("where the robot moves" in text for _, text in made.remarks)
    frames = columns(batches)
    speed = np.linalg.norm(frames["vector3", "V0"])
    assert 2.0 < speed < 8.0


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        (lambda rates: [*rates[:3], *(each / 9.80665 for each in rates[3:])], "is it in g?"),
        (lambda rates: [*rates[:3], *(0.01 * each for each in rates[3:])], "gravity is part of it"),
        (lambda rates: [100.0, *rates[1:]], "are they in degrees per second?"),
    ],
)
def test_other_units_are_said_and_not_used(drive: imu_drive.ImuDrive, change: Any, wanted: str) -> None:
    said = imu_drive.said(drive)
    wrong = [
        each._replace(message=ros.imu(each.ns, change(_rates(each.message)))) if each.topic == "/imu/data_raw" else each
        for each in said
    ]
    made, batches, _ = feed(wrong)
    assert not inertial(batches)
    assert any(wanted in text for _, text in made.remarks)
    assert ("between_se3", "x0", "x1") in columns(batches), "the poses are there"


def _rates(message: Any) -> list[float]:
    w, a = message.angular_velocity, message.linear_acceleration
    return [w.x, w.y, w.z, a.x, a.y, a.z]


def test_without_a_mount_it_is_not_used_and_orientation_is_left(drive: imu_drive.ImuDrive) -> None:
    said = [
        each._replace(message=ros.imu(each.ns, _rates(each.message), orientation=0.0))
        if each.type_name == IMU
        else each
        for each in imu_drive.said(drive)
    ]
    made, batches, _ = feed(said, replace(SETTINGS, mounts={}))
    assert not inertial(batches)
    texts = {text for _, text in made.remarks}
    assert texts == {
        "nothing says where frame 'imu_link' is on the robot: the IMU is not used (--mount)",
        "its orientation is not used: a filter made it of the same samples",
    }


def test_a_robot_that_stands_has_a_keyframe_for_every_thousand_samples() -> None:
    said = []
    for n in range(2600):
        ns = at(0.01 * n)
        said.append(Said("/imu/data_raw", IMU, ns, ros.imu(ns, [0.0, 0.0, 0.0, 0.0, 0.0, 9.80665])))
        if n % 10 == 0:
            said.append(Said("/odom", ODOMETRY, ns, ros.odometry(ns, (0.0, 0.0, 0.0))))
    _, batches, _ = feed(said, replace(SETTINGS, mounts={"imu_link": from_quaternion((0, 0, 0), (0, 0, 0, 1))}))
    assert inertial(batches) == [("x0", "x1"), ("x1", "x2")]


def test_at_an_even_speed_an_imu_feels_nothing_and_odometry_tells_that_the_robot_moves() -> None:
    said = []
    for n in range(301):
        ns = at(0.01 * n)
        said.append(Said("/imu/data_raw", IMU, ns, ros.imu(ns, [0.0, 0.0, 0.0, 0.0, 0.0, 9.80665])))
        if n % 10 == 0:
            said.append(Said("/odom", ODOMETRY, ns, ros.odometry(ns, (0.02 * n, 0.0, 0.0))))
    made, batches, _ = feed(said, replace(SETTINGS, mounts={"imu_link": from_quaternion((0, 0, 0), (0, 0, 0, 1))}))
    assert_allclose(columns(batches)["vector3", "V0"], [2.0, 0.0, 0.0], atol=1e-9)
    assert_allclose(columns(batches)["vector3", "G0"], [0.0, 0.0, -9.80665], atol=1e-9)
    assert any("where the robot moves" in text for _, text in made.remarks)


def test_after_a_refusal_it_goes_on_from_what_is_in_the_map(drive: imu_drive.ImuDrive) -> None:
    said = imu_drive.said(drive)
    frames = list(imu_drive.keyframes(drive))
    cut = next(n for n, each in enumerate(said) if each.topic == "/odom" and each.ns == at(frames[6][0])) + 3
    made = FrontEnd(SETTINGS, 0, (), False)
    batches, there = list[Batch](), set[int]()
    for n, each in enumerate(said):
        if each.topic == "/tf_static":
            continue
        draft = made.take(each.topic, each.type_name, MESSAGES.read(each.topic, each.type_name, each.cdr))
        if draft is not None:
            batch = draft.batch()
            batches.append(batch)
            there |= {key for group in batch.variables for key in group.keys.tolist()}
        if n == cut:
            lost = {symbol(letter, 6) for letter in "xVB"}
            there.difference_update(lost)
            made.rewind(there.__contains__)
    after = batches[next(n for n, batch in enumerate(batches) if ("se3", "x7") in columns([batch])) :]
    for batch in after:
        used = {key for group in batch.factors for key in group.keys.ravel().tolist()}
        assert not used & {symbol(letter, 6) for letter in "xVB"}
    assert ("x7", "x8") in inertial(after)


def test_in_the_plane_it_is_refused_with_a_word(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = recordings.write_mcap(tmp_path / "flat.mcap", imu_drive.said(imu_drive.imu_drive(4))[:60])
    assert main(["replay", str(path), "--in-process", "--imu", "/imu/data_raw"]) != OK
    assert "--space: in the plane there is no inertial factor" in capsys.readouterr().err


def test_the_definition_of_the_message_is_that_of_another_library() -> None:
    assert MESSAGES.hash(IMU) == words.type_hash(words.Imu)


def test_a_recording_with_an_imu_is_replayed_as_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drive = imu_drive.imu_drive()
    recordings.write_mcap(tmp_path / "drive.mcap", imu_drive.said(drive))
    monkeypatch.chdir(tmp_path)
    assert main(BLOCKS[5]) == 0
    rows = [line.split() for line in (tmp_path / "drive.tum").read_text().splitlines()]
    assert len(rows) == len(list(imu_drive.keyframes(drive)))
