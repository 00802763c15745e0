"""A recording with odometry, loop closures, GNSS and an IMU, by a library that is not ours: the map is that of the same
graph as a draft, the same from each kind of recording, and near the truth by as much as it says."""

import json
import math
import subprocess
import sys
from pathlib import Path

import full_drive
import imu_drive
import numpy as np
import pytest
from full_drive import FIX, GRAPH, IMU, IMU_NOISE, ODOM
from test_recordings import same
from test_ros2_imu import assert_same, columns

from factorbus.cli.driving.local import LocalMap, covariances_at
from factorbus.cli.main import main
from factorbus.cli.output.exits import OK
from factorbus.client import Draft, ImuNoise
from factorbus.client.frames import compose, inverse
from factorbus.client.geodetic import enu, geodetic
from factorbus.proto.arrays import F64
from factorbus.proto.messages import Batch
from factorbus.proto.symbols import symbol
from factorbus.ros2.recorded_drive import RecordedDrive, read_recording
from factorbus.ros2.settings import Settings

MADE = full_drive.full_drive()
WORDS = ["--space", "--imu", IMU, "--imu-noise", *map(str, IMU_NOISE)]
SETTINGS = Settings(
    odometry="", poses=(), landmarks=(), space="space", imu=IMU, imu_noise=ImuNoise(*IMU_NOISE)
)  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return full_drive.write(tmp_path_factory.mktemp("drive") / "drive.mcap", MADE)


@pytest.fixture(scope="module")
def recorded(path: Path) -> RecordedDrive:
    return read_recording(path, SETTINGS)


@pytest.fixture(scope="module")
def solved(recorded: RecordedDrive) -> tuple[Batch, dict[int, F64]]:
    """The graph at its optimum, and the values."""
    target = LocalMap("auto")
    for batch in recorded.steps:
        target.send(batch)
    target.settle()
    values = {int(key): row for g in target.estimate() for key, row in zip(g.keys, g.values, strict=True)}  # type: ignore[arg-type]
    return target.graph(), values


def inertial_part(made: full_drive.FullDrive = MADE) -> imu_drive.ImuDrive:
    return imu_drive.ImuDrive(made.imu, made.odometry, made.truth, made.bias)


def keyframes(made: full_drive.FullDrive = MADE) -> list[tuple[float, F64]]:
    return list(imu_drive.keyframes(inertial_part(made)))


def antennas() -> list[tuple[str, F64, F64]]:
    """(keyframe, place east north up of the first fix, place in the map by odometry) of each fix."""
    frames = {round(t, 6): (f"x{n}", row) for n, (t, row) in enumerate(keyframes())}
    there = [geodetic(row, full_drive.ORIGIN) for _, row in MADE.fixes]
    lever = np.array([[*MADE.lever, 0.0, 0.0, 0.0, 1.0]])
    found = []
    for (t, _), fix in zip(MADE.fixes, there, strict=True):
        key, row = frames[round(t, 6)]
        found.append((key, enu(fix, there[0]), compose(row, lever)[0, :3]))
    return found


def frame_at_first() -> F64:
    """T_enu_map by the first fixes: a turn about the vertical and a shift."""
    found = antennas()
    ways = [math.dist(by_odometry[:2], found[0][2][:2]) for _, _, by_odometry in found]
    begun = found[: max(4, next(n for n, way in enumerate(ways) if way > 10 * full_drive.SIGMA_FIX[0]) + 1)]
    here, there = (np.array([each[k] for each in begun]) for k in (2, 1))
    a, b = ((each[:, 0] + 1j * each[:, 1]) for each in (here, there))
    yaw = float(np.angle(np.vdot(a - a.mean(), b - b.mean())))
    turned = compose(np.array([0.0, 0.0, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)]),
                     np.column_stack([here, np.tile([0.0, 0.0, 0.0, 1.0], (len(here), 1))]))  # fmt: skip
    return np.array([*(there - turned[:, :3]).mean(axis=0), 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)])


def drafted() -> Draft:
    """The graph that has to come of it, by nothing of the bridge's."""
    numbers = {round(t, 6): n for n, (t, _) in enumerate(keyframes())}
    draft = imu_drive.drafted(inertial_part(), full_drive.MOUNT)
    for k, n, where in MADE.closures:
        first, second = (numbers[round(MADE.odometry[each][0], 6)] for each in (k, n))
        where = np.append(where[:3], where[3:] * np.sign(where[6]))  # of two quaternions of the same turn
        draft.between_se3(f"x{first}", f"x{second}", where, sigmas=full_drive.SIGMA_CLOSURE)
    row = frame_at_first()
    draft.se3("f0", row).prior_se3("f0", row, sigmas=[1e5] * 3 + [0.1] * 2 + [math.pi])
    for key, place, _ in antennas():
        draft.position_se3(key, place, lever=MADE.lever, frame="f0", sigmas=full_drive.SIGMA_FIX)
    return draft


def test_it_is_the_graph_that_a_draft_of_it_has_with_all_kinds_of_factors(recorded: RecordedDrive) -> None:
    assert not recorded.left_out
    assert recorded.used == {
        ODOM: len(MADE.odometry), IMU: len(MADE.imu), FIX: len(MADE.fixes) + 8, GRAPH: len(MADE.odometry) // 5 + 1
    }  # fmt: skip
    assert_same(list(recorded.steps), [drafted().batch()])
    kinds = [name[0] for name in columns(list(recorded.steps)) if len(name) > 2]
    count = len(keyframes())
    assert kinds.count("between_se3") == count - 1 + len(MADE.closures)
    assert sum(kind.startswith("imu_") for kind in kinds) == count - 1
    assert sum(kind.startswith("position_se3") for kind in kinds) == len(MADE.fixes)
    assert len(MADE.closures) > 30


def test_its_map_is_as_far_from_the_truth_as_it_says(solved: tuple[Batch, dict[int, F64]]) -> None:
    graph, values = solved
    truth = {round(t, 6): row for (t, _), row in zip(MADE.odometry, MADE.truth, strict=True)}
    frames = keyframes()
    asked = np.array([symbol("x", n) for n in range(20, len(frames), 20)], np.int64)
    covariances = covariances_at(graph, asked)
    nees, off, told = [], [], []
    for n in range(20, len(frames), 20):
        t, by_odometry = frames[n]
        error = compose(inverse(values[symbol("x", n)]), truth[round(t, 6)][None])[0]
        error = error[:6] * np.sign(error[6])  # the tangent's, half of a rotation vector
        off.append(float(np.linalg.norm(error[:3])))
        told.append(math.dist(by_odometry[:3], truth[round(t, 6)][:3]))
        nees.append(float(error @ np.linalg.solve(covariances[symbol("x", n)], error)))
    assert np.mean(nees) < 12.0, "6 where each were drawn by itself"
    assert np.mean(nees) > 2.0
    assert max(nees) < 40.0
    assert max(off) < 1.0 < 10.0 < max(told)
    frame = compose(values[symbol("f", 0)], np.array([values[symbol("x", 0)]]))[0]
    origin = enu(geodetic(MADE.fixes[0][1], full_drive.ORIGIN), full_drive.ORIGIN)
    there = compose(MADE.frame, MADE.truth[:1])[0]
    assert np.linalg.norm(frame[:3] - (there[:3] - origin)) < 1.5
    assert np.abs(values[symbol("B", 0)][:3] - MADE.bias[:3]).max() < 1e-3
    assert np.abs(values[symbol("B", 0)][3:] - MADE.bias[3:]).max() < 0.05


@pytest.mark.parametrize("name", ["folder", "drive.bag"])
def test_the_same_drive_as_another_kind_of_recording_is_the_same_map(
    name: str, recorded: RecordedDrive, tmp_path: Path
) -> None:
    other = read_recording(full_drive.write(tmp_path / name, MADE), SETTINGS)
    assert same(other, recorded)
    assert other.notes == recorded.notes


def test_a_script_writes_it_and_one_command_makes_a_picture_and_a_trajectory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    script = Path(full_drive.__file__)
    run = subprocess.run([sys.executable, script, "short.mcap", "--seconds", "40"], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("short.mcap: 40 s, 201 odometries, 4001 samples of an IMU, 33 fixes, ")
    assert main(["replay", "short.mcap", *WORDS, "--plot", "drive.png", "--tum", "drive.tum", "--json"]) == OK
    told = capsys.readouterr()
    document = json.loads(told.out)
    short = len(keyframes(full_drive.full_drive(40)))
    assert document["poses"] == short
    assert document["written"] == ["drive.tum", "drive.png"]
    assert document["chi2_initial"] is None, "velocities that the IMU alone composes are no odometry"
    rows = np.loadtxt(tmp_path / "drive.tum")
    assert rows.shape == (short, 8)
    assert (tmp_path / "drive.png").stat().st_size > 10_000
    for text in ("odometry: /odom", f"closures: {GRAPH}", f"GNSS: {FIX}", "no fix (status -1): left out (8 times)"):
        assert text in " ".join(told.err.split())


def test_how_far_reading_is_is_told(path: Path) -> None:
    told: list[tuple[int, int]] = []
    made = read_recording(path, SETTINGS, show=lambda done, total: told.append((done, total)))
    total = sum(made.used.values())
    assert told == [(1000 * n, total) for n in range(1, total // 1000 + 1)]
    assert len(told) > 10


def test_sensors_without_the_name_of_a_frame_are_said_to_have_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No --mount can name it: where they are has to come from the driver."""
    header = full_drive.RosWords._header
    nameless = lambda words, ns, frame: header(words, ns, frame if frame not in ("gps", "imu_link") else "")  # noqa: E731
    monkeypatch.setattr(full_drive.RosWords, "_header", nameless)
    made = read_recording(full_drive.write(tmp_path / "drive.mcap", full_drive.full_drive(20)), SETTINGS)
    said = " ".join(made.notes)
    assert "its messages have no frame_id, so nothing can say where it is on the robot: the IMU is not used" in said
    assert "no frame_id: the antenna is taken to be at 'base_link' (1" in said
    assert "--mount" not in said
