"""Maps that GLIM has saved: submaps are poses, factors are those of its graph, and what is not there is said."""

import struct
import time
from pathlib import Path

import gtsam
import numpy as np
import pytest
from boost_writing import Factor, Noise
from glim_dumps import FRAMES, T_LIDAR_IMU, DumpedSubmap, between, damping, pose_graph, saved, square_drive, turned
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from naive.dense_factors import residual

from factorbus.formats import FormatError, GraphFile, read, write_graph
from factorbus.formats.rotations import rotation_matrices
from factorbus.proto.messages import Factors
from factorbus.proto.symbols import symbol
from factorbus.solver import solve_batch

LOOP = [(0, 40)]
DRIVE = square_drive(41)
LEFT_OUT = "on velocities, biases or ends of submaps, which this map does not have"


def factors(graph: GraphFile, kind: str, loss: str = "") -> Factors:
    return next(group for group in graph.batch.factors if (group.kind, group.loss) == (kind, loss))


def values(graph: GraphFile) -> np.ndarray:
    """By key."""
    keys = np.concatenate([group.keys for group in graph.batch.variables])
    return np.concatenate([group.values for group in graph.batch.variables if group.values is not None])[
        np.argsort(keys)
    ]


def test_a_pose_graph(tmp_path: Path) -> None:
    graph = read(saved(tmp_path / "map", DRIVE, factors=pose_graph(DRIVE, LOOP)), strict=True)
    assert (graph.dialect, graph.poses, graph.batch.factor_count, dict(graph.left_out)) == ("glim", 41, 41, {})
    first, rest = graph.batch.variables
    assert (first.fixed, first.keys.tolist()) == (True, [symbol("x", 0)])
    assert rest.keys.tolist() == [symbol("x", k) for k in range(1, 41)]
    assert first.stamps is not None
    assert first.stamps.tolist() == [1700000000300000001], "of the middle frame, to the nanosecond"
    np.testing.assert_allclose(values(graph)[12], [50, 12, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-5)
    odometry, loop = factors(graph, "between_se3"), factors(graph, "between_se3", "huber")
    assert (len(odometry.keys), loop.keys.tolist()) == (40, [[symbol("x", 0), symbol("x", 40)]])
    assert odometry.information[0][[0, 20]].tolist() == pytest.approx([1e6, 4e6]), "rotations as half angles"
    assert loop.scale is not None
    assert loop.scale.tolist() == [1.0]
    assert loop.information[0][[0, 20]].tolist() == pytest.approx([100, 400])


def test_it_is_weighed_and_solved_as_in_gtsam(tmp_path: Path) -> None:
    """A whole information, in GTSAM's order of the tangent space; the optimum is GTSAM's."""
    rng = np.random.default_rng(3)
    root = np.triu(rng.normal(size=(6, 6))) + 3 * np.eye(6)
    T = turned(1, 2, 0.3) @ np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 1], [0, 0, 0, 1.0]])
    made = [
        damping(),
        between(0, 1, T, Noise(6, root=root)),
        between(1, 2, T, Noise(6, 0.1)),
        between(0, 2, T, Noise(6, 0.2)),
    ]
    graph = read(saved(tmp_path / "map", DRIVE[:3], factors=made), strict=True)
    group = factors(graph, "between_se3")
    theirs = gtsam.NonlinearFactorGraph()
    theirs.add(gtsam.NonlinearEqualityPose3(0, gtsam.Pose3(DRIVE[0].T_world_origin)))
    for pair, noise in (
        ((0, 1), gtsam.noiseModel.Gaussian.SqrtInformation(root)),
        ((1, 2), gtsam.noiseModel.Isotropic.Sigma(6, 0.1)),
        ((0, 2), gtsam.noiseModel.Isotropic.Sigma(6, 0.2)),
    ):
        theirs.add(gtsam.BetweenFactorPose3(*pair, gtsam.Pose3(T), noise))
    near = gtsam.Pose3(T).retract(1e-4 * rng.normal(size=6))
    poses = [
        np.array([0.0, 0, 0, 0, 0, 0, 1]),
        np.array([*near.translation(), *near.rotation().toQuaternion().coeffs()]),
    ]
    r = residual("between_se3", poses, group.measured[0])
    full = np.zeros((6, 6))
    full[np.triu_indices(6)] = group.information[0]
    full += np.triu(full, 1).T
    at = gtsam.Values()
    at.insert(0, gtsam.Pose3())
    at.insert(1, near)
    assert r @ full @ r == pytest.approx(2 * theirs.at(1).error(at), rel=1e-3)


def test_the_optimum_of_a_drive_is_gtsams(tmp_path: Path) -> None:
    """Where the drift is small: large errors are logarithms in GTSAM, and parts of quaternions here."""
    drive = square_drive(41, drift=2e-4)
    graph = read(saved(tmp_path / "map", drive, factors=pose_graph(drive, LOOP)))
    whole = graph.whole()
    solved = solve_batch(whole.variables, whole.factors)
    ours = {key: pose for group in solved.values for key, pose in zip(group.keys.tolist(), group.values, strict=True)}
    theirs, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    theirs.add(gtsam.NonlinearEqualityPose3(symbol("x", 0), gtsam.Pose3(drive[0].T_world_origin)))
    for factor in pose_graph(drive, LOOP)[1:]:
        noise = gtsam.noiseModel.Isotropic.Sigma(6, factor.noise.sigma)
        if factor.noise.huber:
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(factor.noise.huber), noise)
        theirs.add(
            gtsam.BetweenFactorPose3(*factor.keys, gtsam.Pose3(gtsam.Rot3(factor.rotation), factor.vector), noise)
        )
    for number, submap in enumerate(drive):
        start.insert(symbol("x", number), gtsam.Pose3(submap.T_world_origin))
    best = gtsam.LevenbergMarquardtOptimizer(theirs, start).optimize()
    for number in range(41):
        np.testing.assert_allclose(
            ours[symbol("x", number)][:3], best.atPose3(symbol("x", number)).translation(), atol=2e-3
        )


def test_matching_costs_are_what_glim_has_found(tmp_path: Path) -> None:
    costs = [("vgicp_gpu", k, k + 1) for k in range(40)] + [("gicp", 0, 40), ("", 1, 40)]
    folder = saved(tmp_path / "map", DRIVE, costs, [damping()], imu=True)
    graph = read(folder)
    assert "42 matching_costs (gicp, unnamed, vgicp_gpu) read as the relative pose" in graph.notes[0]
    assert "of the IMU at its middle frame" in graph.notes[1]
    group = factors(graph, "between_se3")
    assert group.keys[40].tolist() == [symbol("x", 0), symbol("x", 40)]
    wanted = np.linalg.inv(DRIVE[0].T_world_origin @ T_LIDAR_IMU) @ DRIVE[40].T_world_origin @ T_LIDAR_IMU
    np.testing.assert_allclose(group.measured[40, :3], wanted[:3, 3], atol=1e-3)
    np.testing.assert_allclose(rotation_matrices(group.measured[40:41])[0], wanted[:3, :3], atol=1e-5)
    whole = graph.whole()
    assert solve_batch(whole.variables, whole.factors).chi2 == pytest.approx(0, abs=1e-6), (
        "the map is where GLIM has left it"
    )
    with pytest.raises(FormatError, match="42 matching_cost, of which the relative pose"):
        read(folder, strict=True)


def test_what_is_of_the_imu_is_left_out_and_said(tmp_path: Path) -> None:
    of_imu = [
        Factor(
            "gtsam::BetweenFactor<gtsam::Pose3>",
            (symbol("x", 0), symbol("e", 1)),
            Noise(6, 1e-3),
            np.eye(3),
            np.zeros(3),
        ),
        Factor("gtsam_points::RotateVector3Factor", (symbol("x", 0), symbol("v", 1)), Noise(3, 1e-3), None, np.ones(3)),
        Factor("gtsam::PriorFactor<gtsam::imuBias::ConstantBias>", (symbol("b", 1),), Noise(6, 1e-3), None, np.ones(6)),
    ]
    folder = saved(tmp_path / "map", DRIVE[:2], [("vgicp", 0, 1)], [damping(), *of_imu])
    graph = read(folder)
    names = ("BetweenFactor<Pose3>", "RotateVector3Factor", "PriorFactor<imuBias::ConstantBias>")
    assert graph.left_out == dict.fromkeys(names, 1)
    assert f"1 RotateVector3Factor left out: {LEFT_OUT}" in graph.notes
    with pytest.raises(FormatError, match="1 BetweenFactor<Pose3>, on velocities"):
        read(folder, strict=True)


def test_gnss_and_priors_hold_the_map(tmp_path: Path) -> None:
    made = [
        *pose_graph(DRIVE[:3])[1:],
        Factor(
            "gtsam::PoseTranslationPrior<gtsam::Pose3>", (symbol("x", 2),), Noise(3, 0.5), None, np.array([1.0, 2, 3])
        ),
        Factor("gtsam::PriorFactor<gtsam::Pose3>", (symbol("x", 1),), Noise(6, 0.5), np.eye(3), np.array([4.0, 5, 6])),
    ]
    graph = read(saved(tmp_path / "map", DRIVE[:3], factors=made), strict=True)
    assert not any(group.fixed for group in graph.batch.variables)
    position = factors(graph, "position_se3")
    assert (position.keys.tolist(), position.measured.tolist()) == ([[symbol("x", 2)]], [[1, 2, 3, 0, 0, 0]])
    assert position.information.tolist() == [[4, 0, 0, 4, 0, 4]]
    assert factors(graph, "prior_se3").measured.tolist() == [[4, 5, 6, 0, 0, 0, 1]]


@pytest.mark.parametrize("content", [None, b"", b"\0" * 50])
def test_without_a_graph_odometry_joins_the_submaps(tmp_path: Path, content: bytes | None) -> None:
    folder = saved(tmp_path / "map", DRIVE)
    if content is not None:
        (folder / "graph.bin").write_bytes(content)
    graph = read(folder / "graph.txt")
    assert graph.left_out == {"graph.bin": 1}
    assert "40 submaps that nothing joins to earlier ones placed by odometry" in graph.notes[1]
    measured = factors(graph, "between_se3").measured[12]
    wanted = np.linalg.inv(DRIVE[12].origin()) @ DRIVE[13].origin()
    np.testing.assert_allclose(measured[:3], wanted[:3, 3], atol=1e-3)
    assert len(graph.steps()) == 41


def test_what_comes_after_an_unknown_factor_is_lost_and_said(tmp_path: Path) -> None:
    made = pose_graph(DRIVE, LOOP)
    made.insert(11, Factor("glim::LooseFactor", (symbol("x", 3),)))
    graph = read(saved(tmp_path / "map", DRIVE, factors=made))
    assert graph.left_out == {"of the factors in graph.bin": 32}
    why = "what comes after 11 factors cannot be read: a glim::LooseFactor, whose form is not known here"
    assert graph.notes[0] == f"32 of the factors in graph.bin left out: {why}"
    assert "30 submaps that nothing joins" in graph.notes[1]


def test_another_session_is_not_joined_by_odometry(tmp_path: Path) -> None:
    again = [DumpedSubmap(submap.T_world_origin, submap.odometry, submap.first_id) for submap in DRIVE[:3]]
    folder = saved(tmp_path / "map", [*DRIVE[:3], *again])
    with pytest.raises(FormatError, match=r"map: .*(parts|joins)"):
        read(folder).steps()
    (folder / "graph.txt").write_text((folder / "graph.txt").read_text() + "matching_cost vgicp 1 4\n")
    assert read(folder).steps().poses == 6


def test_pruned_submaps_are_not_in_the_map(tmp_path: Path) -> None:
    more = "num_active_frames: 10\nnum_pruned_submaps: 2\nnum_pruned_ranges: 1\npruned_range 1 2\n"
    graph = read(saved(tmp_path / "map", DRIVE[:5], [("vgicp", 0, 3)], [damping()], more=more))
    assert [key for group in graph.batch.variables for key in group.keys.tolist()] == [
        symbol("x", k) for k in (0, 3, 4)
    ]


def test_it_is_written_in_other_forms(tmp_path: Path) -> None:
    graph = read(saved(tmp_path / "map", DRIVE, factors=pose_graph(DRIVE, LOOP)))
    for name in ("map.g2o", "map.pyfg", "map.jrl"):
        write_graph(tmp_path / name, graph.batch, False, "auto", None)
        again = read(tmp_path / name)
        np.testing.assert_allclose(values(again), values(graph), atol=1e-12)
        assert again.batch.factor_count == 41


BAD = {
    "graph.txt": [
        ("num_submaps: 3", "num_submaps: x", r"graph.txt:1: num_submaps: with x; wanted a whole number"),
        ("num_submaps: 3", "num_submaps: 0", "no submap; wanted a line"),
        ("num_submaps: 3", "num_submaps: 9", r"000003/data.txt: it cannot be read \(No such file"),
        ("num_submaps: 3", "num_submaps: 99999999", "99,999,999 submaps; wanted"),
        ("vgicp 0 1", "vgicp 0 7", r"graph.txt:4: matching_cost of submap 7; wanted one of the 3"),
        ("vgicp 0 1", "vgicp 1 1", "matching_cost of submap 1 with itself; wanted two"),
        ("vgicp 0 1", "vgicp 0 -1", "with -1; wanted a whole number"),
        ("vgicp 0 1", "", "matching_cost with "),
        ("num_submaps: 3", "num_submaps: 3\npruned_range 0 2", "every one of 3 submaps pruned; wanted one or more"),
        ("num_submaps: 3", "pruned_range 0 0\nnum_submaps: 3", "graph.txt:5: matching_cost of submap 0; wanted one of"),
    ],
    "000001/data.txt": [
        ("T_world_origin: \n1 0", "T_world_origin: \n2 0", r"data.txt:2: T_world_origin that is no rotation"),
        ("T_world_origin: \n1 0", "T_world_origin: \n0", "T_world_origin with 15 numbers; wanted 16"),
        ("T_world_origin: \n1 0", "T_world_origin: \nnan 0", "T_world_origin with"),
        ("T_origin_endpoint_L", "T_origin_endpoint", "no T_origin_endpoint_L; wanted a line"),
        ("stamp: 1700000000.8", "stamp: never", "a time of 'never"),
        ("id: 5", "id: five", "with five; wanted a whole number"),
        ("frame_id:", "frame_id: 2 2", "frame_id with 3 numbers; wanted 1"),
    ],
}


@pytest.mark.parametrize(("name", "good", "bad", "said"), [(name, *case) for name in BAD for case in BAD[name]])
def test_what_is_wrong_is_named(tmp_path: Path, name: str, good: str, bad: str, said: str) -> None:
    folder = saved(tmp_path / "map", DRIVE[:3], [("vgicp", 0, 1)], [damping()])
    path = folder / name
    lines = path.read_text().splitlines()
    squeezed = "\n".join(" ".join(line.split()) + (" " if line.endswith(": ") else "") for line in lines)
    assert good in squeezed
    path.write_text(squeezed.replace(good, bad, 1) + "\n")
    with pytest.raises(FormatError, match=said):
        read(folder)


def test_many_pruned_ranges_take_no_time(tmp_path: Path) -> None:
    folder = saved(tmp_path / "map", DRIVE[:1], more="pruned_range 0 999998\n" * 400)
    text = (folder / "graph.txt").read_text()
    (folder / "graph.txt").write_text(text.replace("num_submaps: 1", "num_submaps: 1000000"))
    begun = time.process_time()
    with pytest.raises(FormatError, match=r"999999/data\.txt: it cannot be read"):
        read(folder)
    assert time.process_time() - begun < 3.0


def test_what_a_method_is_called_is_shown_only_where_it_is_a_name(tmp_path: Path) -> None:
    folder = saved(tmp_path / "map", DRIVE[:3], [("\x1b[31m", 0, 1), ("m" * 5000, 0, 2)], [damping()])
    (note,) = [note for note in read(folder).notes if "matching_cost" in note]
    assert "2 matching_costs (unnamed)" in note


def test_a_loss_whose_scale_is_no_number_is_left_out(tmp_path: Path) -> None:
    folder = saved(tmp_path / "map", DRIVE[:3], factors=pose_graph(DRIVE[:3], [(0, 2)]))
    content = (folder / "graph.bin").read_bytes()
    at, scale = content.index(b"Huber"), struct.pack("<d", 1.0)
    place = content.index(scale, at)
    for name, number in ((b"Huber", -1.0), (b"Huber", float("nan"))):
        bad = content[:place] + struct.pack("<d", number) + content[place + 8 :]
        (folder / "graph.bin").write_bytes(bad)
        assert any(f"loss {name.decode()} of {number:g}" in note for note in read(folder).notes)
    dcs = content[: at - len(b"gtsam::noiseModel::mEstimator::") - 8]
    whole = b"gtsam::noiseModel::mEstimator::DCS"
    dcs += (
        struct.pack("<Q", len(whole)) + whole + content[at + 5 : place] + struct.pack("<d", -1.0) + content[place + 8 :]
    )
    (folder / "graph.bin").write_bytes(dcs)
    assert any("loss DCS of -1" in note for note in read(folder).notes)


def test_a_graph_txt_that_is_empty_is_said_to_be(tmp_path: Path) -> None:
    folder = saved(tmp_path / "map", DRIVE[:3], factors=pose_graph(DRIVE[:3]))
    (folder / "graph.txt").write_text("")
    with pytest.raises(FormatError, match=r"graph.txt: no submap; wanted a line"):
        read(folder)


@given(
    st.sampled_from(["graph.txt", "000000/data.txt", "graph.bin"]),
    st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.binary(min_size=1, max_size=3)), min_size=1, max_size=4),
)
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_damaged_maps_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, name: str, changes: list[tuple[float, bytes]]
) -> None:
    folder = saved(tmp_path_factory.mktemp("glim") / "map", DRIVE[:3], [("vgicp", 0, 2)], pose_graph(DRIVE[:3]))
    content = bytearray((folder / name).read_bytes())
    for place, piece in changes:
        at = int(place * len(content))
        content[at : at + len(piece)] = piece
    (folder / name).write_bytes(bytes(content))
    try:
        graph = read(folder)
        if graph.dialect == "glim":
            graph.steps()
    except FormatError:
        pass


def test_frames_are_counted(tmp_path: Path) -> None:
    graph = read(saved(tmp_path / "map", DRIVE[:4], factors=pose_graph(DRIVE[:4])))
    assert graph.notes[-1].startswith(
        f"4 submaps of {4 * FRAMES} frames, each the pose of the lidar at its middle frame"
    )
