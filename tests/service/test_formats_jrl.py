"""JRL files as JRL's documents and programs write them are read; and weighed as GTSAM does, whose terms they have."""

import json
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from jrl_logs import A0, A1, B0, COVARIANCE6, L0, L1, PLANE, SPACE, T0, read_text
from naive.dense_factors import residual

from factorbus.formats import FormatError, GraphFile, read
from factorbus.proto.messages import Factors
from factorbus.proto.stamps import NO_STAMP


def factors(graph: GraphFile, kind: str) -> Factors:
    return next(group for group in graph.batch.factors if group.kind == kind)


def test_the_plane(tmp_path: Path) -> None:
    graph = read_text(tmp_path, PLANE, strict=True)
    assert (graph.dialect, graph.poses, graph.landmarks, graph.batch.factor_count) == ("jrl", 3, 2, 7)
    stamps = {
        key: stamp
        for group in graph.batch.variables
        if group.stamps is not None
        for key, stamp in zip(group.keys.tolist(), group.stamps.tolist(), strict=True)
    }
    assert stamps == {A0: T0, B0: T0 + 10, A1: T0 + 20}, "of the first entry of its own robot that names a pose"
    valued = [(group.kind, group.keys.tolist()) for group in graph.batch.variables if group.values is not None]
    assert valued == [("se2", [A0]), ("point2", [L0])]
    prior = factors(graph, "prior_se2")
    covariance = np.array([[0.01, 0.002, 0], [0.002, 0.04, 0], [0, 0, 0.0025]])
    np.testing.assert_allclose(prior.information[0], np.linalg.inv(covariance)[np.triu_indices(3)], rtol=1e-13)
    seen = factors(graph, "bearing_range_se2")
    assert (seen.keys.tolist(), seen.measured.tolist()) == ([[A1, L0]], [[-0.5, 4.0]])
    assert seen.information[0].tolist() == pytest.approx([1e4, 0, 4])
    assert factors(graph, "range_se2").measured.tolist() == [[6.5]]
    assert factors(graph, "range_between_se2").keys.tolist() == [[A0, B0]]


def test_what_a_log_has_beside_the_graph(tmp_path: Path) -> None:
    graph = read_text(tmp_path, PLANE)
    assert graph.log is not None
    assert graph.log.name == "yard"
    assert {group.kind: group.keys.tolist() for group in graph.log.ground_truth} == {"se2": [A0, B0], "point2": [L0]}
    assert graph.log.ground_truth[0].values is not None
    assert graph.log.ground_truth[0].values[0].tolist() == [0.5, 0.0625, 0.25]
    labels = {group.kind: of for group, of in zip(graph.batch.factors, graph.log.labels, strict=True)}
    assert labels["between_se2"].potential.tolist() == [True, False], "that of b is of an earlier time"
    assert labels["bearing_range_se2"].potential.tolist() == [True]
    assert (labels["range_se2"].potential.tolist(), labels["range_se2"].outlier.tolist()) == ([True], [True])
    assert labels["between_se2"].robots.tolist() == [ord("b"), ord("a")]
    assert labels["between_se2"].stamps.tolist() == [T0 + 10, T0 + 20]
    assert graph.summary() == {
        "dialect": "jrl",
        "notes": list(graph.notes),
        "left_out": {},
        "ground_truth": 3,
        "potential_outliers": 3,
        "outliers": 1,
    }
    assert graph.notes == (
        "ground truth of 3 variables; labels: 3 potential outliers, 1 outlier; they are factors as all others",
    )


def test_the_plane_is_weighed_as_gtsam_does(tmp_path: Path) -> None:
    batch = read_text(tmp_path, PLANE).batch
    start, rng = gtsam.Pose2(0.5, 0, 0.25), np.random.default_rng(5)
    true = {A0: start, A1: start.compose(gtsam.Pose2(1, 0.25, 0.5)), B0: start.compose(gtsam.Pose2(3, 4, 0))}
    values, at = gtsam.Values(), {L0: np.array([4.0, -1.0]), L1: np.array([7.0, 1.5])}
    for key, pose in true.items():  # near what was measured, where all charts of a pose are the same
        values.insert(key, near := pose.compose(gtsam.Pose2(*1e-5 * rng.normal(size=3))))
        at[key] = np.array([near.x(), near.y(), near.theta()])
    for key in (L0, L1):
        values.insert(key, at[key])

    def noise(*rows: list[float]) -> gtsam.noiseModel.Gaussian:
        return gtsam.noiseModel.Gaussian.Covariance(np.array(rows))

    moved = noise([0.01, 0, 0], [0, 0.04, 0], [0, 0, 0.0025])
    wanted = {
        "prior_se2": [
            gtsam.PriorFactorPose2(
                A0, gtsam.Pose2(0.5, 0, 0.25), noise([0.01, 0.002, 0], [0.002, 0.04, 0], [0, 0, 0.0025])
            )
        ],
        "between_se2": [
            gtsam.BetweenFactorPose2(A0, B0, gtsam.Pose2(3, 4, 0), noise([1, 0, 0], [0, 1, 0], [0, 0, 1])),
            gtsam.BetweenFactorPose2(A0, A1, gtsam.Pose2(1, 0.25, 0.5), moved),
        ],
        "bearing_range_se2": [gtsam.BearingRangeFactor2D(A1, L0, gtsam.Rot2(-0.5), 4, noise([0.0001, 0], [0, 0.25]))],
        "range_se2": [gtsam.RangeFactor2D(A1, L1, 6.5, noise([0.0625]))],
        "range_between_se2": [gtsam.RangeFactorPose2(A0, B0, 5, noise([0.25]))],
        "prior_point2": [gtsam.PriorFactorPoint2(L1, np.array([7.0, 1.0]), noise([1, 0.5], [0.5, 1]))],
    }
    assert {group.kind for group in batch.factors} == set(wanted)
    for group in batch.factors:
        for keys, z, packed, of in zip(group.keys, group.measured, group.information, wanted[group.kind], strict=True):
            r = residual(group.kind, [at[key] for key in keys.tolist()], z)
            full = np.zeros((len(r), len(r)))
            full[np.triu_indices(len(r))] = packed
            assert r @ (full + np.triu(full, 1).T) @ r == pytest.approx(2 * of.error(values), rel=1e-3), group.kind


def pose3(row: np.ndarray) -> gtsam.Pose3:
    return gtsam.Pose3(gtsam.Rot3.Quaternion(row[6], *row[3:6]), row[:3])


def test_space_is_weighed_as_gtsam_does(tmp_path: Path) -> None:
    graph = read_text(tmp_path, SPACE, strict=True)
    assert all(group.stamps is None for group in graph.batch.variables), "all stamps are 0"
    noise = gtsam.noiseModel.Gaussian.Covariance(COVARIANCE6)
    z = pose3(np.array([1, 0, 0.5, 0.5, -0.5, 0.5, 0.5]))
    between, prior = gtsam.BetweenFactorPose3(0, 1, z, noise), gtsam.PriorFactorPose3(0, z, noise)
    rng = np.random.default_rng(3)
    for _ in range(5):
        move = gtsam.Pose3.Expmap(1e-4 * rng.normal(size=6))
        values = gtsam.Values()
        values.insert(0, pose3(np.array([1, 2, 3, 0, 0, 0.6, 0.8])))
        values.insert(1, values.atPose3(0).compose(z).compose(move))
        alone = gtsam.Values()
        alone.insert(0, z.compose(move))
        for kind, of, at, keys in (("between_se3", between, values, (0, 1)), ("prior_se3", prior, alone, (0,))):
            group = factors(graph, kind)
            ends = [np.concatenate([at.atPose3(k).translation(), quat_xyzw(at.atPose3(k))]) for k in keys]
            measured = group.measured[0] if kind == "between_se3" else np.array([1, 0, 0.5, 0.5, -0.5, 0.5, 0.5])
            r = residual(kind, ends, measured)
            full = np.zeros((6, 6))
            full[np.triu_indices(6)] = group.information[0]
            chi2 = r @ (full + np.triu(full, 1).T) @ r
            assert chi2 == pytest.approx(2 * of.error(at), rel=1e-3)
    assert factors(graph, "between_se3").measured[0].tolist() == [1, 0, 0.5, 0.5, -0.5, 0.5, 0.5]
    assert factors(graph, "range_se3").keys.tolist() == [[A0, L0]]
    assert factors(graph, "range_between_se3").measured.tolist() == [[1.25]]
    assert graph.log is not None
    assert graph.log.potential_outliers == 1


def quat_xyzw(pose: gtsam.Pose3) -> np.ndarray:
    q = pose.rotation().toQuaternion()
    return np.array([q.x(), q.y(), q.z(), q.w()])


def test_it_is_known_by_its_first_letter_or_its_ending(tmp_path: Path) -> None:
    assert read_text(tmp_path, f"\n  {SPACE}", "a.g2o").dialect == "jrl"
    assert read(tmp_path / "a.g2o", "jrl").dialect == "jrl"
    with pytest.raises(FormatError, match=r"a\.jrl:1: no JSON at column 1"):
        read_text(tmp_path, "VERTEX_SE2 0 0 0 0\n")


def edited(text: str, change: Any) -> str:
    document = json.loads(text)
    change(document)
    return json.dumps(document)


def measurement(document: Any, entry: int = 0, number: int = 0, robot: str = "a") -> Any:
    return document["measurements"][robot][entry]["measurements"][number]


FIRST, SECOND = "measurements.a[0].measurements[0]", "measurements.a[1].measurements[0]"
REFUSED = {
    "nothing": (lambda d: d.pop("measurements"), "no measurements; wanted an object with measurements"),
    "robot": (lambda d: d["measurements"].update(ab=[]), "measurements.ab: the robot 'ab'; wanted robots that are a"),
    "stamp": (lambda d: d["measurements"]["a"][0].update(stamp=-1), "measurements.a[0].stamp: -1; wanted a whole"),
    "time": (lambda d: d["measurements"]["a"][0].update(stamp=1.5), "measurements.a[0].stamp: 1.5; wanted a whole"),
    "entry": (lambda d: d["measurements"]["a"].append(7), "measurements.a[3]: 7; wanted a JSON object"),
    "list": (lambda d: d["measurements"].update(b="x"), 'measurements.b: "x"; wanted a JSON array'),
    "type": (lambda d: measurement(d).pop("type"), f"{FIRST}: no type; wanted an object with type"),
    "key": (lambda d: measurement(d).update(key=True), f"{FIRST}.key: true; wanted a whole number from 0 to"),
    "big": (lambda d: measurement(d).update(key=2**63), f"{FIRST}.key: 9223372036854775808; wanted a whole number"),
    "value": (lambda d: measurement(d)["prior"].update(x="1"), f'{FIRST}.prior.x: "1"; wanted a finite number'),
    "field": (lambda d: measurement(d)["prior"].pop("theta"), f"{FIRST}.prior: no theta; wanted an object with theta"),
    "kind": (lambda d: measurement(d)["prior"].update(type="Pose3"), f'{FIRST}.prior.type: "Pose3"; wanted "Pose2"'),
    "size": (lambda d: measurement(d).update(covariance=[1]), f"{FIRST}.covariance: an array of 1; wanted an array of"),
    "sign": (lambda d: measurement(d).update(covariance=[0.0] * 9), f"{FIRST}: PriorFactorPose2 with a covariance ma"),
    "askew": (
        lambda d: measurement(d)["covariance"].__setitem__(1, 0.003),
        f"{FIRST}: PriorFactorPose2 with a covariance matrix that is not symmetric",
    ),
    "itself": (lambda d: measurement(d, 1).update(key2=A0), f"{SECOND}: BetweenFactorPose2 from a0 to itself"),
    "range": (
        lambda d: measurement(d, 1, 2)["measurement"].update(value=0),
        "measurements.a[1].measurements[2]: RangeFactor2D of 0; wanted a distance above 0",
    ),
    "kinds": (
        lambda d: measurement(d, 1, 2).update(key2=B0),
        "measurements.a[1].measurements[2]: b0 as a 2D point, which is a 2D pose at measurements.b[0].measurements[0]",
    ),
    "twice": (
        lambda d: d["initialization"].update(b=[{"type": "Pose2", "key": A0, "x": 9, "y": 0, "theta": 0}]),
        "initialization.b[0]: a0 again, other than at initialization.a[0]; wanted one value for a key",
    ),
    "outlier": (
        lambda d: d["outlier_factors"].update(b=[[0, 2]]),
        "outlier_factors.b[0]: measurement 2 of entry 0, which is not there; wanted [entry, measurement]",
    ),
    "label": (lambda d: d["outlier_factors"].update(b=[[0]]), "outlier_factors.b[0]: an array of 1; wanted [entry, m"),
    "name": (lambda d: d.update(name=7), "name: 7; wanted a string"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_broken_is_refused_with_its_place(tmp_path: Path, case: str) -> None:
    change, said = REFUSED[case]
    with pytest.raises(FormatError) as caught:
        read_text(tmp_path, edited(PLANE, change))
    assert f"a.jrl: {said}" in str(caught.value)
    assert caught.value.line is None


NO_JSON = {
    '{"measurements": {,}}': ":1: no JSON at column 19",
    '{"measurements":\n {"a": [NaN]}}': ": NaN, which is no number of JSON; wanted JSON in UTF-8",
    '{"name": "a", "name": "b"}': ": an object with name twice; wanted JSON in UTF-8, in which each object has",
    '{"name": ' + "[" * 100_000: ": JSON that is nested too deeply",
    '{"name": ' + "9" * 5000 + "}": ": Exceeds the limit",
}


@pytest.mark.parametrize("text", NO_JSON, ids=range(len(NO_JSON)))
def test_what_is_no_json_is_said_with_the_line(tmp_path: Path, text: str) -> None:
    with pytest.raises(FormatError) as caught:
        read_text(tmp_path, text)
    assert f"a.jrl{NO_JSON[text]}" in str(caught.value)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.jrl").write_bytes(b'{\n"name": "\xff"}')
    with pytest.raises(FormatError, match=r"a\.jrl:2: bytes that are not UTF-8"):
        read(tmp_path / "a.jrl")


IMU = {"type": "CombinedImuFactor", "key0": 1, "covariance": [1]}
LEFT_OUT = {
    "CombinedImuFactor": (
        lambda d: d["measurements"]["b"].append({"stamp": T0 + 40, "measurements": [IMU, IMU]}),
        2,
        "no JRL measurement that is read; the first is measurements.b[1].measurements[0]",
    ),
    "initialization Vector": (
        lambda d: d["initialization"]["a"].append({"type": "Vector", "key": 2_000_000_000, "data": [1, 2, 3]}),
        1,
        "no JRL value that is read; the first is initialization.a[2]",
    ),
    "groundtruth Rot3": (
        lambda d: d["groundtruth"]["b"].append({"type": "Rot3", "key": 1, "rotation": [1, 0, 0, 0]}),
        1,
        "no JRL value that is read; the first is groundtruth.b[1]",
    ),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_what_has_no_kind_is_left_out_and_said(tmp_path: Path, name: str) -> None:
    change, count, why = LEFT_OUT[name]
    text = edited(PLANE, change)
    graph = read_text(tmp_path, text)
    assert graph.left_out == {name: count}
    assert f"{count} {name} left out: {why}" in graph.notes
    with pytest.raises(FormatError, match="strict"):
        read_text(tmp_path, text, strict=True)


def test_a_label_of_what_is_left_out_is_of_no_factor(tmp_path: Path) -> None:
    def change(document: Any) -> None:
        measurement(document, 1, 2)["type"] = "RangeFactorWithTransform2D"

    graph = read_text(tmp_path, edited(PLANE, change))
    assert graph.log is not None
    assert (graph.log.potential_outliers, graph.log.outliers) == (2, 0)


def test_a_time_that_stands_beside_a_value_is_its_own(tmp_path: Path) -> None:
    def change(document: Any) -> None:
        pose, point = document["initialization"]["a"]
        pose["stamp"], point["stamp"] = None, 7

    graph = read_text(tmp_path, edited(PLANE, change))
    stamps = {
        key: stamp
        for group in graph.batch.variables
        if group.stamps is not None
        for key, stamp in zip(group.keys.tolist(), group.stamps.tolist(), strict=True)
        if stamp != NO_STAMP
    }
    assert stamps == {B0: T0 + 10, A1: T0 + 20, L0: 7}


@pytest.mark.parametrize("entry", ["a[0]", "b[0]"])
def test_a_truth_of_another_kind_than_the_variable_is_refused_with_its_place(tmp_path: Path, entry: str) -> None:
    """A pose in space where the map is a plane: of a variable that has a value, and of one that has none."""
    document = json.loads(PLANE)
    wrong = document["groundtruth"][entry[0]][0]
    for name in ("x", "y", "theta"):
        wrong.pop(name, None)
    wrong |= {"type": "Pose3", "translation": [1, 2, 3], "rotation": [1, 0, 0, 0]}
    with pytest.raises(FormatError, match=rf"groundtruth\.{entry[0]}\[0\]"):
        read_text(tmp_path, json.dumps(document))
