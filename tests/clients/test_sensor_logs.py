"""Logs of an IMU with GNSS, odometry or poses: what `simulate inertial` writes `replay` finds out; EuRoC, KITTI."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from bench.calibration import off
from naive.dense_factors import boxminus
from scipy.special import chdtri

from factorbus.cli.logs.log_steps import pose_times
from factorbus.cli.logs.recognize import read_log
from factorbus.cli.logs.write_euroc import ORIGIN, write_world
from factorbus.cli.main import main
from factorbus.cli.output.exits import BAD_FILE, OK, USAGE
from factorbus.client.geodetic import enu, geodetic
from factorbus.formats import FormatError
from factorbus.proto.symbols import symbol
from factorbus.simulate import InertialWorld, inertial
from factorbus.solver import Options, Solver
from factorbus.solver.covariance.blocks import CovarianceBlocks

DATA = Path(gtsam.__file__).parent / "Data"


def driven(folder: Path) -> Solver:
    solver = Solver(Options())
    for batch in read_log(folder).steps():
        solver.stage(batch)
        solver.step()
    solver.step(settle=True)
    return solver


def poses_of(solver: Solver) -> dict[int, np.ndarray]:
    groups = [group for group in solver.estimate() if group.kind == "se3"]
    return {key: row for g in groups for key, row in zip(g.keys.tolist(), g.values, strict=True)}


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, InertialWorld]:
    world = inertial(80, 2)
    folder = tmp_path_factory.mktemp("logs") / "drive"
    write_world(folder, world)
    return folder, world


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_map_finds_frame_lever_and_mount_within_three_sigma(tmp_path: Path, seed: int) -> None:
    world = inertial(100, seed)
    write_world(tmp_path, world)
    solver = driven(tmp_path)
    for key, kind, truth in (("f", "se3", world.frame), ("a", "vector3", world.lever), ("m", "se3", world.mount)):
        d2, sigmas = off(solver, symbol(key, 0), kind, truth)
        assert d2 < chdtri(sigmas.size, 0.0027), (key, d2)
        assert np.abs(sigmas).max() < 3.5
    factored = solver.covariances.factored()
    turned = CovarianceBlocks(factored).joint(np.array([factored.graph.find(symbol("m", 0))]))[3:, 3:]
    assert np.sqrt(4 * turned.diagonal()).max() < 0.5 * world.errors.mount[3], "the drive has shown how it is turned"


def test_the_same_seed_is_the_same_world_and_a_pose_follows_from_the_samples() -> None:
    world, again = inertial(20, 4), inertial(20, 4)
    for one, other in zip(vars_of(world), vars_of(again), strict=True):
        np.testing.assert_array_equal(one, other)
    params = gtsam.PreintegrationParams.MakeSharedU(9.80665)
    params.setIntegrationCovariance(np.eye(3) * 1e-12)
    bias = gtsam.imuBias.ConstantBias(world.bias[3:], world.bias[:3])
    for first in range(0, 900, 100):
        made = gtsam.PreintegratedImuMeasurements(params, bias)
        for row in world.imu[first : first + 100]:
            made.integrateMeasurement(row[4:], row[1:4], 0.01)
        at = [gtsam.Pose3(gtsam.Rot3.Quaternion(p[7], *p[4:7]), p[1:4]) for p in world.truth[[first, first + 100]]]
        end = made.predict(gtsam.NavState(at[0], world.velocity[first]), bias)
        assert np.linalg.norm(end.pose().translation() - at[1].translation()) < 0.05  # the noise of a second
        assert np.linalg.norm(end.attitude().logmap(at[1].rotation())) < 0.01


def vars_of(world: InertialWorld) -> list[np.ndarray]:
    return [world.imu, world.gnss, world.odometry, world.truth, world.frame, world.lever, world.mount, world.bias]


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (900.0, -1200.0, 35.0), (-4000.0, 7000.0, -10.0)])
def test_geodetic_is_enu_backwards(place: tuple[float, float, float]) -> None:
    np.testing.assert_allclose(enu(geodetic(place, ORIGIN), ORIGIN), place, atol=1e-6)


@pytest.mark.parametrize("origin", [(47.0, 359.99, 0.0), (47.0, -359.99, 0.0), (89.99, 10.0, 0.0), (-90.0, 0.0, 0.0)])
@pytest.mark.parametrize("place", [(5000.0, 0.0, 3.0), (-5000.0, 200.0, 0.0), (0.0, 5000.0, 0.0)])
def test_a_place_beyond_a_full_turn_or_a_pole_is_named_as_it_is_taken(
    origin: tuple[float, ...], place: tuple[float, ...]
) -> None:
    np.testing.assert_allclose(enu(geodetic(place, origin), origin), place, atol=1e-6)


def test_replay_says_what_it_took_and_how_far_it_is_from_the_truth(
    drive: tuple[Path, InertialWorld], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, _ = drive
    assert main(["replay", str(folder), "--in-process", "--json"]) == OK
    told = capsys.readouterr()
    result = json.loads(told.out)
    assert result["read"]["dialect"] == "euroc"
    assert result["error_m"]["rms"] < 0.6
    for said in ("samples of", "fixes of", "poses of", "nothing of them is used", "stands still", "f0 is found out"):
        assert said in told.err
    assert (result["inserts"], result["landmarks"]) == (80, 0)


def test_a_room_s_poses_hold_the_map_in_their_frame(drive: tuple[Path, InertialWorld], tmp_path: Path) -> None:
    folder, _ = drive
    mav = tmp_path / "mav0"
    for name in ("imu0", "state_groundtruth_estimate0"):
        _copied(folder / "mav0" / name, mav / name)
    (mav / "vicon0").mkdir()
    truth = (mav / "state_groundtruth_estimate0" / "data.csv").read_text().splitlines()
    rows = [",".join(line.split(",")[:8]) for line in truth[1::20]]
    (mav / "vicon0" / "data.csv").write_text("#timestamp\n" + "\n".join(rows) + "\n")
    solver = driven(tmp_path)
    steps = read_log(tmp_path).steps()
    (truth_of,) = steps.truth()
    poses = poses_of(solver)
    assert truth_of.values is not None
    pairs = zip(truth_of.keys.tolist(), truth_of.values, strict=True)
    far = [np.linalg.norm(boxminus("se3", row, poses[key])[:3]) for key, row in pairs]
    assert max(far) < 0.05


def _copied(source: Path, target: Path) -> None:
    target.mkdir(parents=True)
    for file in source.iterdir():
        (target / file.name).write_bytes(file.read_bytes())


def oxts(folder: Path, world: InertialWorld, hz: int = 10) -> Path:
    """The drive as KITTI raw has it; velocities and angles are not used and 0."""
    data = folder / "oxts" / "data"
    data.mkdir(parents=True)
    times, every = [], 100 // hz
    antenna = np.array([(gtsam.Pose3(gtsam.Rot3.Quaternion(p[7], *p[4:7]), p[1:4])).translation() for p in world.truth])
    for n, row in enumerate(world.imu[::every]):
        packet = np.zeros(30)
        packet[:3], packet[23] = geodetic(antenna[n * every], ORIGIN), 0.1
        packet[11:14], packet[17:20] = world.imu[n * every : (n + 1) * every, 4:].mean(axis=0), row[1:4]
        (data / f"{n:010d}.txt").write_text(" ".join(map(repr, packet.tolist())) + "\n")
        seconds = 10 * 60 + row[0]
        times.append(f"2011-09-26 13:{int(seconds // 60):02d}:{seconds % 60:012.9f}")
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(times) + "\n")
    return folder


def test_kitti_raw_follows_its_fixes(drive: tuple[Path, InertialWorld], tmp_path: Path) -> None:
    folder = oxts(tmp_path, drive[1])
    log = read_log(folder)
    assert log.dialect == "kitti raw"
    assert len(log.imu.times) == 396
    steps, solver = log.steps(), driven(folder)
    poses = poses_of(solver)
    true = drive[1].truth[:, 1:4] - drive[1].truth[0, 1:4]
    seconds = (steps.times - log.imu.times[0]) * 1e-9
    far = [np.linalg.norm(poses[symbol("x", n)][:3] - true[round(100 * t)]) for n, t in enumerate(seconds)]
    assert max(far) < 0.5


def test_the_kitti_drive_of_gtsam_ends_at_its_positions() -> None:
    log = read_log(DATA / "KittiGps_converted.txt")
    assert log.dialect == "kitti of gtsam"
    steps, solver = log.steps(), Solver(Options())
    for batch in steps[:60]:
        solver.stage(batch)
        solver.step()
    poses = poses_of(solver)
    fixes = log.fixes
    assert fixes is not None
    far = [np.linalg.norm(poses[symbol("x", n)][:3] - fixes.places[n]) for n in range(60)]
    assert np.sqrt(np.mean(np.square(far))) < 0.5


def test_no_two_poses_have_more_samples_between_than_a_factor_takes(tmp_path: Path) -> None:
    write_world(tmp_path, inertial(80, 5))
    for name in ("gps0", "odom0"):
        file = tmp_path / "mav0" / name / "data.csv"
        lines = file.read_text().splitlines()
        file.write_text("\n".join([*lines[:4], lines[-1]]) + "\n")
    log = read_log(tmp_path)
    assert np.diff(np.searchsorted(log.imu.times, pose_times(log))).max() <= 1000


def _line(number: int, text: str) -> Callable[[Path], None]:
    def change(file: Path) -> None:
        lines = file.read_text().splitlines()
        lines[number - 1] = text
        file.write_text("\n".join(lines) + "\n")

    return change


BAD: dict[str, tuple[str, Any, str]] = {
    "a word": ("imu0/data.csv", _line(7, "1700000000050000000,0,0,x,0,0,9.8"), r"data.csv:7: .*'x'"),
    "no number": ("imu0/data.csv", _line(7, "1700000000050000000,0,0,nan,0,0,9.8"), r"data.csv:7: .*not finite"),
    "few columns": ("imu0/data.csv", _line(9, "1700000000070000000,0,0"), r"data.csv:9: 3 columns; wanted 7"),
    "time backwards": ("odom0/data.csv", _line(5, "5,0,0,0,1,0,0,0"), r"data.csv:5: the time 5 ns after"),
    "time in seconds": (
        "gps0/data.csv",
        _line(4, "1.7e9,48,11,5,1,1,1"),
        r"data.csv:4: the time '1.7e9'; wanted nanos",
    ),
    "no quaternion": ("odom0/data.csv", _line(4, "1700000001000000000,0,0,0,2,0,0,0"), "quaternion has length 2"),
    "latitude": ("gps0/data.csv", _line(3, "1700000001000000000,148,11,5,1,1,1"), "2. fix: latitude 148"),
    "longitude": ("gps0/data.csv", _line(3, "1700000001000000000,48,1100,5,1,1,1"), "2. fix: .*, longitude 1100"),
    "mount": ("odom0/sensor.yaml", lambda file: file.write_text("T_BS: [1, 2]\n"), "T_BS of 2 numbers"),
    "noise": ("imu0/sensor.yaml", lambda file: file.write_text("gyroscope_noise_density: -1\n"), "gyroscope"),
    "no row": ("imu0/data.csv", lambda file: file.write_text("#\n"), "no row at all"),
    "no file": ("imu0/data.csv", lambda file: file.unlink(), "cannot be read"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_refused_with_its_line_and_the_reason(
    drive: tuple[Path, InertialWorld], tmp_path: Path, case: str
) -> None:
    for name in ("imu0", "gps0", "odom0"):
        _copied(drive[0] / "mav0" / name, tmp_path / "mav0" / name)
    name, change, said = BAD[case]
    change(tmp_path / "mav0" / name)
    with pytest.raises(FormatError, match=said) as refused:
        read_log(tmp_path)
    assert refused.value.code == "bad_file"


def test_a_folder_that_is_no_log_or_has_an_imu_alone_is_refused(
    drive: tuple[Path, InertialWorld], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(tmp_path), "--in-process"]) == BAD_FILE
    assert "a folder without a log or a recording that is known" in capsys.readouterr().err
    _copied(drive[0] / "mav0" / "imu0", tmp_path / "imu0")
    with pytest.raises(FormatError, match="an IMU alone drifts away"):
        read_log(tmp_path)
    (tmp_path / "b" / "oxts" / "data").mkdir(parents=True)
    (tmp_path / "b" / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.5\nyesterday\n")
    with pytest.raises(FormatError, match=r"timestamps\.txt:2: the time 'yesterday'"):
        read_log(tmp_path / "b")


def test_inertial_is_a_folder_and_the_others_are_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "inertial", "--out", str(tmp_path / "a.g2o")]) == USAGE
    assert main(["simulate", "sphere", "--folder", str(tmp_path / "a")]) == USAGE
    assert main(["simulate", "inertial", "--poses", "10", "--folder", str(tmp_path / "a")]) == OK
    assert "truth.json" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "a" / "truth.json").read_text())["mount"]) == 7


def edited(drive: tuple[Path, InertialWorld], folder: Path, file: str, edit: Callable[[str], str]) -> Path:
    """A copy of a drive, of which one file reads otherwise."""
    shutil.copytree(drive[0], folder)
    path = folder / "mav0" / file
    path.write_text(edit(path.read_text()))
    return folder


MOUNTED = "T_BS: [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0.25], [0, 0, 0, 1]]\n"


@pytest.mark.parametrize(
    "text", [MOUNTED, MOUNTED.replace("[[", "\n  - [").replace("], [", "]\n  - [").replace("]]", "]")]
)
def test_a_mount_may_be_written_row_by_row(drive: tuple[Path, InertialWorld], tmp_path: Path, text: str) -> None:
    log = read_log(edited(drive, tmp_path / "rows", "gps0/sensor.yaml", lambda _: text))
    assert log.fixes is not None
    np.testing.assert_allclose(log.fixes.lever, [0.5, 0, 0.25])


@pytest.mark.parametrize(
    ("file", "text", "found"),
    [
        ("gps0/sensor.yaml", "origin: [48.1N, 11.6E, 520]\n", "48.1N"),
        ("gps0/sensor.yaml", "T_BS: the middle\n", "numbers of T_BS|numbers .of T_BS"),
        ("gps0/sensor.yaml", "T_BS:\n", "T_BS without a number"),
        ("odom0/sensor.yaml", "sigma_position: [0.02, 0.02, 0.02]\n", "sigma_position"),
        ("odom0/sensor.yaml", "sigma_angle: -1\n", "sigma_angle"),
        ("imu0/sensor.yaml", MOUNTED, "poses are those of the IMU"),
        ("imu0/sensor.yaml", "gyroscope_noise_density: small\n", "gyroscope_noise_density"),
    ],
)
def test_what_a_sensor_yaml_says_is_used_or_refused(
    drive: tuple[Path, InertialWorld], tmp_path: Path, file: str, text: str, found: str
) -> None:
    folder = edited(drive, tmp_path / "edited", file, lambda _: text)
    with pytest.raises(FormatError, match=found) as refused:
        read_log(folder)
    assert "sensor.yaml" in str(refused.value)


def test_where_samples_were_lost_the_map_goes_on(drive: tuple[Path, InertialWorld], tmp_path: Path) -> None:
    def lose(text: str) -> str:
        lines = text.splitlines()
        return "\n".join(lines[:700] + lines[1000:])

    folder = edited(drive, tmp_path / "lost", "imu0/data.csv", lose)
    assert any("1 gap" in note for note in read_log(folder).notes)
    assert len(poses_of(driven(folder))) > 80


def test_units_that_cannot_be_are_said(drive: tuple[Path, InertialWorld], tmp_path: Path) -> None:
    def in_g(text: str) -> str:
        first, *lines = text.splitlines()
        rows = [line.split(",") for line in lines]
        return "\n".join(
            [first, *(",".join([*row[:4], *(str(float(cell) / 9.80665) for cell in row[4:])]) for row in rows)]
        )

    assert not any("IMU:" in note for note in read_log(drive[0]).notes)
    (note,) = [note for note in read_log(edited(drive, tmp_path / "g", "imu0/data.csv", in_g)).notes if "IMU:" in note]
    assert "is it in g?" in note


def test_a_simulated_log_has_the_poses_that_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, truth = tmp_path / "drive", tmp_path / "truth.tum"
    assert main(["simulate", "inertial", "--poses", "12", "--folder", str(folder), "--truth", str(truth)]) == OK
    said = capsys.readouterr().err
    assert f"{folder}: 12 poses" in said
    assert f"{truth}: 12 poses, as they are" in said
    assert read_log(folder).steps().poses == len(truth.read_text().splitlines()) == 12


def test_a_log_where_a_graph_is_wanted_is_told_how_one_is_made_of_it(
    drive: tuple[Path, InertialWorld], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["convert", str(drive[0]), str(tmp_path / "a.g2o")], ["plot", "sparsity", str(drive[0])]):
        assert main(arguments) == BAD_FILE
        told = f"a log of an IMU; wanted a graph: factorbus replay {drive[0]} --in-process --out map.g2o makes one"
        assert told in capsys.readouterr().err
