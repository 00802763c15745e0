"""Forms in which JRL files come beside JSON with labels by robot: CBOR, labels in arrays, directions in space."""

import contextlib
import json
import struct
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jrl_logs import A0, A1, L0, PLANE, SPACE, read_text
from naive.dense_factors import residual

from factorbus.cli.main import main
from factorbus.formats import FormatError, GraphFile, as_jrl, read, recoded, write_jrl
from factorbus.formats.cbor import as_cbor, is_cbor, parsed_cbor
from factorbus.proto.messages import Batch, Factors, Variables

# RFC 8949, Appendix A: what there is of JSON in it.
APPENDIX = {
    "00": 0, "01": 1, "0a": 10, "17": 23, "1818": 24, "1903e8": 1000, "1a000f4240": 1000000,
    "1b000000e8d4a51000": 1000000000000, "1bffffffffffffffff": 2**64 - 1, "3bffffffffffffffff": -(2**64), "20": -1,
    "3903e7": -1000, "f90000": 0.0, "f93c00": 1.0, "f97bff": 65504.0, "fa47c35000": 100000.0,
    "fb3ff199999999999a": 1.1, "f90001": 2.0**-24, "fbc010666666666666": -4.1, "f4": False, "f5": True, "f6": None,
    "60": "", "6161": "a", "6449455446": "IETF", "62c3bc": "ü", "80": [], "83010203": [1, 2, 3],
    "8301820203820405": [1, [2, 3], [4, 5]],
    "98190102030405060708090a0b0c0d0e0f101112131415161718181819": list(range(1, 26)), "a0": {},
    "a26161016162820203": {"a": 1, "b": [2, 3]}, "826161a161626163": ["a", {"b": "c"}],
    "7f657374726561646d696e67ff": "streaming", "9fff": [], "9f018202039f0405ffff": [1, [2, 3], [4, 5]],
    "83018202039f0405ff": [1, [2, 3], [4, 5]], "bf61610161629f0203ffff": {"a": 1, "b": [2, 3]},
    "bf6346756ef563416d7421ff": {"Fun": True, "Amt": -2},
    "9f0102030405060708090a0b0c0d0e0f101112131415161718181819ff": list(range(1, 26)),
}  # fmt: skip
NO_CBOR = {
    "a1": "byte 1 (it ends too early)",
    "a16161": "byte 3 (it ends too early)",
    "a1616101ff": "byte 4 (something behind the end)",
    "a10101": "byte 1 (an object whose member has a name that is no text)",
    "a2616101616102": "byte 0 (an object with a twice)",
    "a1616143010203": "byte 3 (bytes or a tag, which JSON does not have)",
    "a16161c11a514b67b0": "byte 3 (bytes or a tag, which JSON does not have)",
    "a16161f7": "byte 3 (a simple value of 23, which JSON does not have)",
    "a161617fff01": "byte 5 (something behind the end)",
    "a161617f01ff": "byte 4 (a piece of a text that is no text)",
    "a1616161ff": "byte 3 (a text that is not UTF-8)",
    "a161611c": "byte 3 (a head of 0x1c)",
    "a161619bffffffffffffffff": "byte 12 (it ends too early)",
    "a161617bffffffffffffffff": "byte 3 (it ends too early)",
    "a1616119": "byte 3 (it ends too early)",
    "a16161fb3ff1": "byte 3 (it ends too early)",
    "a16161" + "81" * 100 + "00": "byte 67 (nested too deeply)",
}
DOUBLES = st.floats(allow_nan=False)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | DOUBLES | st.text(),
    lambda of: st.lists(of, max_size=30) | st.dictionaries(st.text(), of, max_size=30) | st.lists(DOUBLES),
    max_leaves=40,
)


@pytest.mark.parametrize("code", APPENDIX)
def test_the_examples_of_the_standard_are_read(code: str) -> None:
    found = parsed_cbor("a.cbor", bytes.fromhex(code)).value
    assert (found, type(found)) == (APPENDIX[code], type(APPENDIX[code]))


@given(value=st.dictionaries(st.text(), JSON))
def test_what_is_written_is_read(value: dict[str, Any]) -> None:
    written = as_cbor(value)
    assert is_cbor(written)
    for content in (written, b"\xd9\xd9\xf7" + written):
        assert parsed_cbor("a.cbor", content).value == value


@given(data=st.data())
def test_damaged_bytes_are_read_or_refused(data: st.DataObject) -> None:
    content = bytearray(recoded(PLANE))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(FormatError):
        parsed_cbor("a.cbor", bytes(content[: data.draw(st.integers(1, len(content)))]))


@pytest.mark.parametrize("code", NO_CBOR)
def test_what_is_no_cbor_is_refused_with_its_byte(tmp_path: Path, code: str) -> None:
    (tmp_path / "a.jrl.cbor").write_bytes(bytes.fromhex(code))
    with pytest.raises(FormatError) as caught:
        read(tmp_path / "a.jrl.cbor")
    assert f"a.jrl.cbor: no CBOR at {NO_CBOR[code]}" in str(caught.value)


@pytest.mark.parametrize("text", [PLANE, SPACE], ids=["plane", "space"])
def test_a_log_in_cbor_is_the_log_in_json(tmp_path: Path, text: str) -> None:
    """Floats of four bytes, too, where they say the same: JRL's programs write them so."""
    plain = read_text(tmp_path, text)
    short = recoded(text).replace(b"\xfb" + struct.pack(">d", 0.25), b"\xfa" + struct.pack(">f", 0.25))
    for content in (recoded(text), short):
        (tmp_path / "b.jrl.cbor").write_bytes(content)
        assert_same(read(tmp_path / "b.jrl.cbor"), plain)
    write_jrl(tmp_path / "c.jrl.cbor", plain.batch, log=plain.log)
    assert (tmp_path / "c.jrl.cbor").read_bytes() == recoded(as_jrl(plain.batch, log=plain.log).text)
    assert_same(read(tmp_path / "c.jrl.cbor"), plain)


def test_the_command_line_writes_and_reads_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for words in (
        ["simulate", "manhattan", "--poses", "12", "--out", "a.jrl.cbor"],
        ["convert", "a.jrl.cbor", "b.jrl", "--strict"],
        ["convert", "b.jrl", "c.jrl.cbor", "--strict"],
        ["replay", "c.jrl.cbor", "--in-process", "--mode", "inc-l", "--out", "d.cbor"],
        ["solve", "c.jrl.cbor", "--out", "e.cbor"],
    ):
        assert main(words) == 0, words
    assert Path("c.jrl.cbor").read_bytes() == recoded(Path("b.jrl").read_text())
    assert [read(name).summary()["ground_truth"] for name in ("a.jrl.cbor", "d.cbor", "e.cbor")] == [12, 12, 12]


def factors(graph: GraphFile, kind: str) -> Factors:
    return next(group for group in graph.batch.factors if group.kind == kind)


def assert_same(graph: GraphFile, other: GraphFile) -> None:
    assert (graph.dialect, graph.notes) == (other.dialect, other.notes)
    assert str(graph.batch) == str(other.batch)
    assert str(graph.log) == str(other.log)


# ---- labels

BY_ROBOT = {"a": [[1, 1], [1, 2]], "b": [[0, 1]]}
ARRAYS = {
    "letters": [["a", [[1, 1], [1, 2]]], ["b", [[0, 1]]]],
    "codes": [[98, [[0, 1]]], [97, [[1, 1], [1, 2]]]],
    "in order": [[[1, 1], [1, 2]], [[0, 1]]],
    "of nobody": [[1, 1], [0, 1], [1, 2]],  # no entry of the other robot has these numbers
}


@pytest.mark.parametrize("form", ARRAYS)
def test_arrays_of_labels_say_what_an_object_says(tmp_path: Path, form: str) -> None:
    plain = read_text(tmp_path, labelled(potential_outlier_factors=BY_ROBOT))
    assert_same(read_text(tmp_path, labelled(potential_outlier_factors=ARRAYS[form]), strict=True), plain)
    assert plain.log is not None
    assert plain.log.potential_outliers == 3


@pytest.mark.parametrize("empty", [[], None, [[], None], {"a": None}])
def test_there_may_be_none(tmp_path: Path, empty: Any) -> None:
    graph = read_text(tmp_path, labelled(potential_outlier_factors=empty, outlier_factors=empty), strict=True)
    assert graph.log is not None
    assert (graph.log.potential_outliers, graph.log.outliers) == (0, 0)


def test_labels_of_which_nobody_knows_whose_they_are_are_left_out_and_said(tmp_path: Path) -> None:
    """Entry 0 of both robots has a measurement 0."""
    graph = read_text(tmp_path, text := labelled(outlier_factors=[[0, 0], [1, 2]]))
    assert graph.left_out == {"outliers": 2}
    assert graph.notes[0] == (
        "2 outliers left out: they are an array that names no robot, and several robots have such measurements"
    )
    assert graph.log is not None
    assert (graph.log.potential_outliers, graph.log.outliers) == (3, 0)
    with pytest.raises(FormatError, match="strict"):
        read_text(tmp_path, text, strict=True)


@pytest.mark.parametrize(
    ("labels", "said"),
    [
        ([[0, 7]], "outlier_factors[0]: measurement 7 of entry 0, which is not there; wanted [entry, measurement]"),
        ([[[0, 0]]], "outlier_factors: an array of 1; wanted an array for each of 2 robots"),
        ([["ab", [[0, 0]]]], 'outlier_factors[0][0]: "ab"; wanted a whole number from 0 to 127'),
        ([["b", [[2, 0]]]], "outlier_factors[0][1][0]: measurement 0 of entry 2, which is not there"),
        ([7], "outlier_factors[0]: 7; wanted a JSON array"),
        ([[0, 1, 2]], "outlier_factors[0]: an array of 3; wanted [entry, measurement]"),
    ],
)
def test_wrong_labels_are_refused_with_their_place(tmp_path: Path, labels: Any, said: str) -> None:
    with pytest.raises(FormatError) as caught:
        read_text(tmp_path, labelled(outlier_factors=labels))
    assert said in str(caught.value)


def labelled(**labels: Any) -> str:
    return json.dumps(json.loads(PLANE) | labels)


# ---- directions in space

SURE = np.array([[0.0004, 0.0001, 0.001], [0.0001, 0.0009, -0.002], [0.001, -0.002, 0.04]])
POSE = np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3, np.sqrt(1 - 0.14)])


def seen(bearing: Any, distance: Any, covariance: np.ndarray = SURE) -> str:
    document = json.loads(SPACE)
    del document["potential_outlier_factors"]
    document["measurements"]["a"][0]["measurements"][3:] = [
        {
            "type": "BearingRangeFactor3D",
            "key1": A0,
            "key2": L0,
            "covariance": covariance.ravel().tolist(),
            "measurement": {"type": "BearingRange", "bearing": bearing, "range": distance},
        }
    ]
    return json.dumps(document)


def unit3(n: np.ndarray) -> dict[str, Any]:
    return {"type": "Unit3", **dict(zip("ijk", n.tolist(), strict=True))}


@pytest.mark.parametrize("n", [[0.6, 0.0, 0.8], [-0.48, 0.64, -0.6], [0.8, -0.36, 0.48], [-0.28, -0.96, 0.0]])
def test_near_what_was_measured_it_is_weighed_as_gtsam_does(tmp_path: Path, n: list[float]) -> None:
    """Where no two axes are as near: there GTSAM's tangent space jumps from one to the other."""
    direction, distance = np.array(n), 5.0
    group = factors(read_text(tmp_path, seen(unit3(direction), {"type": "Scalar", "value": distance})), "landmark_se3")
    np.testing.assert_allclose(group.measured, [direction * distance], rtol=1e-12, atol=1e-12)
    full = np.zeros((3, 3))
    full[np.triu_indices(3)] = group.information[0]
    noise = gtsam.noiseModel.Gaussian.Covariance(SURE)
    of = gtsam.BearingRangeFactor3D(0, 1, gtsam.Unit3(direction), distance, noise)
    pose = gtsam.Pose3(gtsam.Rot3.Quaternion(POSE[6], *POSE[3:6]), POSE[:3])
    rng = np.random.default_rng(4)
    for _ in range(10):
        point = pose.transformFrom(direction * distance + 1e-5 * rng.normal(size=3))
        values = gtsam.Values()
        values.insert(0, pose)
        values.insert(1, point)
        r = residual("landmark_se3", [POSE, point], group.measured[0])
        assert r @ (full + np.triu(full, 1).T) @ r == pytest.approx(2 * of.error(values), rel=1e-4)


def test_a_direction_may_be_three_numbers_of_any_length_and_that_it_is_a_position_is_said(tmp_path: Path) -> None:
    graph = read_text(tmp_path, seen([3, 0, 4], 5), strict=True)
    np.testing.assert_allclose(factors(graph, "landmark_se3").measured, [[3, 0, 4]], rtol=1e-15)
    assert graph.notes == ("1 BearingRangeFactor3D read as positions in the frames of the poses, exact to first order",)
    again = read_text(tmp_path, seen(unit3(np.array([3.0, 0, 4])), {"type": "Scalar", "value": 5}))
    assert str(again.batch) == str(graph.batch)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (seen([0, 0, 0], 5), "measurements[3]: BearingRangeFactor3D along no direction; wanted a direction of some le"),
        (seen([1, 0, 0], 0), "measurements[3]: BearingRangeFactor3D of 0; wanted a distance above 0"),
        (seen([1, 0], 5), "measurements[3].measurement.bearing: an array of 2; wanted an array of 3 numbers"),
        (seen({"type": "Rot2", "theta": 1}, 5), 'measurement.bearing.type: "Rot2"; wanted "Unit3"'),
        (
            seen([1, 0, 0], 5, SURE - np.eye(3)),
            "measurements[3]: BearingRangeFactor3D with a covariance matrix that is",
        ),
        (seen([1, 0, 0], 5, np.triu(SURE)), "BearingRangeFactor3D with a covariance matrix that is not symmetric"),
    ],
)
def test_what_is_none_is_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(FormatError) as caught:
        read_text(tmp_path, text)
    assert said in str(caught.value)


def test_points_in_space_are_written_so_and_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    positions = np.array([[3.0, 0, 4], [0, 0, 0], [-1, 1, 1], [0, 7, 0]])
    root = np.tril(rng.normal(size=(4, 3, 3))) + 2 * np.eye(3)
    information = (root @ np.swapaxes(root, 1, 2))[:, *np.triu_indices(3)]
    points = np.array([L0 + k for k in range(4)])
    batch = Batch(
        (Variables("se3", np.array([A0, A1]), np.array([POSE, POSE])), Variables("point3", points, positions + 1)),
        (
            Factors("landmark_se3", np.array([[A0, p] for p in points]), positions, information),
            Factors("between_se3", np.array([[A0, A1]]), POSE[None], np.eye(6)[np.triu_indices(6)][None]),
        ),
    )
    notes = write_jrl(tmp_path / "a.jrl", batch)
    assert notes == (
        "1 landmark_se3 left out: a point that is where its pose is has no direction",
        "3 landmark_se3 written as BearingRangeFactor3D, exact to first order",
    )
    with pytest.raises(FormatError, match="strict"):
        write_jrl(tmp_path / "b.jrl", batch, strict=True)
    back = factors(read(tmp_path / "a.jrl"), "landmark_se3")
    kept = [0, 2, 3]
    assert back.keys.tolist() == [[A0, points[k]] for k in kept]
    np.testing.assert_allclose(back.measured, positions[kept], rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose(back.information, information[kept], rtol=1e-12, atol=1e-12)
    assert len(read(tmp_path / "a.jrl").steps()) == 2
