"""What is written as JRL is read again as it was, and a replay takes it in the order of its stamps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from jrl_logs import A0, A1, A2, B0, B1, L0, PLANE, SPACE, T0, read_text

from factorbus.formats import GRAPHS, FormatError, GraphFile, as_jrl, read, write_graph, write_jrl
from factorbus.proto.kinds import FACTOR_KINDS, VARIABLE_KINDS
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import symbol

KINDS = (
    "prior_se2", "prior_se3", "prior_point2", "prior_point3", "between_se2", "between_se3", "bearing_range_se2",
    "range_se2", "range_se3", "range_between_se2", "range_between_se3",
)  # fmt: skip
LETTERS = {"se2": "A", "se3": "B", "point2": "L", "point3": ""}


def told(batch: Batch) -> dict[int, tuple[Any, ...]]:
    """Of each variable its kind, value and time stamp."""
    found = {}
    for group in batch.variables:
        values = [None] * len(group.keys) if group.values is None else map(tuple, group.values.tolist())
        stamps = [NO_STAMP] * len(group.keys) if group.stamps is None else group.stamps.tolist()
        for key, value, stamp in zip(group.keys.tolist(), values, stamps, strict=True):
            found[key] = group.kind, value, stamp
    return found


def rows(batch: Batch) -> list[tuple[Any, ...]]:
    """Factors in some order: kind, keys, measured, and the information to the digits that two inversions keep."""
    found = []
    for group in batch.factors:
        scale = np.abs(group.information).max(axis=1, keepdims=True)
        weights = np.round(group.information / scale, 9) + 0.0
        columns = zip(group.keys.tolist(), group.measured.tolist(), weights.tolist(), scale[:, 0].tolist(), strict=True)
        found += [(group.kind, keys, measured, info, float(f"{size:.9g}")) for keys, measured, info, size in columns]
    return sorted(found)


def assert_same(one: Batch, other: Batch) -> None:
    assert told(one) == told(other)
    assert [row[:3] for row in rows(one)] == [row[:3] for row in rows(other)]
    for mine, theirs in zip(rows(one), rows(other), strict=True):
        np.testing.assert_allclose(np.array(mine[3]) * mine[4], np.array(theirs[3]) * theirs[4], atol=1e-7 * mine[4])


def labels(graph: GraphFile) -> list[tuple[Any, ...]]:
    assert graph.log is not None
    found = []
    for group, of in zip(graph.batch.factors, graph.log.labels, strict=True):
        columns = [each.tolist() for each in (group.keys, of.stamps, of.robots, of.potential, of.outlier)]
        found += [(group.kind, *row) for row in zip(*columns, strict=True)]
    return sorted(found)


@pytest.mark.parametrize("text", [PLANE, SPACE], ids=["plane", "space"])
def test_what_is_read_is_written_and_read_again_with_its_log(tmp_path: Path, text: str) -> None:
    graph = read_text(tmp_path, text)
    assert graph.log is not None
    assert write_jrl(tmp_path / "b.jrl", graph.batch, strict=True, log=graph.log) == ()
    again = read(tmp_path / "b.jrl", strict=True)
    assert again.log is not None
    assert_same(graph.batch, again.batch)
    assert labels(graph) == labels(again)
    assert again.log.name == graph.log.name
    assert told(Batch(graph.log.ground_truth)) == told(Batch(again.log.ground_truth))


def random_graph(seed: int, kinds: set[str], stamped: bool) -> Batch:
    """Three variables of each kind, all with values, and two factors of each of `kinds`."""
    rng = np.random.default_rng(seed)

    def value(size: int) -> np.ndarray:
        row = 3 * rng.normal(size=size)
        if size == 7:
            row[3:] /= np.linalg.norm(row[3:])
        return row

    first = {kind: symbol(letter, int(rng.integers(1000))) for kind, letter in LETTERS.items()}
    variables = []
    for kind, key in first.items():
        values = np.array([value(VARIABLE_KINDS[kind].size) for _ in range(3)])
        stamps = rng.choice([NO_STAMP, -5, 0, *rng.integers(1, 2**62, 3)], 3) if stamped else None
        variables.append(Variables(kind, key + np.arange(3), values, False, stamps))
    groups = []
    for name in (name for name in FACTOR_KINDS if name in kinds):
        kind = FACTOR_KINDS[name]
        ends = [rng.permutation(3)[: len(kind.connects)] for _ in range(2)]
        keys = np.array([[first[end] + row[k] for k, end in enumerate(kind.connects)] for row in ends])
        z = np.array([value(kind.size) for _ in ends])
        roots = [rng.normal(size=(kind.dim, kind.dim)) + 2 * np.eye(kind.dim) for _ in ends]
        packed = np.array([(root.T @ root + 0.1 * np.eye(kind.dim))[np.triu_indices(kind.dim)] for root in roots])
        if "range" in name:
            z[:, -1] = np.abs(z[:, -1]) + 0.1
        groups.append(Factors(name, keys, z, packed))
    return Batch(tuple(variables), tuple(groups))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), kinds=st.sets(st.sampled_from(KINDS), min_size=1), stamped=st.booleans())
def test_any_graph_of_these_kinds_is_the_same_after_writing_and_reading(
    tmp_path: Path, seed: int, kinds: set[str], stamped: bool
) -> None:
    batch = random_graph(seed, kinds, stamped)
    assert write_jrl(tmp_path / "a.jrl", batch, strict=True) == ()
    assert_same(batch, read(tmp_path / "a.jrl", strict=True, whole=True).batch)


def chain(
    stamps: list[int] | None, fixed: bool = False, steps: tuple[tuple[int, int], ...] = ((0, 1), (1, 2))
) -> Batch:
    """a0 a1 a2, without values, and steps between them."""
    keys = np.array([A0, A1, A2])
    poses = Variables("se2", keys, None, fixed, None if stamps is None else np.array(stamps))
    measured, information = np.array([[1.0, 0, 0]] * 2), np.array([[1.0, 0, 0, 1, 0, 4]] * 2)
    return Batch((poses,), (Factors("between_se2", keys[np.array(steps)], measured, information),))


def test_entries_are_those_of_the_poses() -> None:
    document = json.loads(as_jrl(chain([10, 20, 30]), name="row").text)
    assert (document["name"], document["robots"], list(document)) == ("row", [97], ["name", "robots", "measurements"])
    entries = document["measurements"]["a"]
    assert [entry["stamp"] for entry in entries] == [20, 30]
    assert entries[0]["measurements"] == [
        {
            "type": "BetweenFactorPose2",
            "key1": A0,
            "key2": A1,
            "measurement": {"type": "Pose2", "x": 1.0, "y": 0.0, "theta": 0.0},
            "covariance": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.25],
        }
    ]
    untimed = json.loads(as_jrl(chain(None)).text)["measurements"]["a"]
    assert [(entry["stamp"], len(entry["measurements"])) for entry in untimed] == [(0, 1), (0, 1)]


def test_what_jrl_has_no_record_for_is_left_out_and_said() -> None:
    poses, *_ = chain([10, 20, 30], fixed=True).variables
    points = Variables("point2", np.array([L0]), np.zeros((1, 2)))
    seen = np.array([[A0, L0]])
    near = Factors("landmark_se2", seen, np.ones((1, 2)), np.array([[1.0, 0, 1]]))
    far = Factors("range_se2", seen, np.ones((1, 1)), np.ones((1, 1)), "huber", np.ones(1))
    batch = Batch((points, poses), (near, far, *chain(None).factors))
    written = as_jrl(batch)
    assert written.left_out == {"fixed variables": 3, "landmark_se2": 1, "range_se2 loss": 1}
    late = as_jrl(chain([10, 20, 30], steps=((0, 2), (1, 2))))
    assert late.left_out == {"time stamps": 2}, "of a0 and a1, which have no value that a time could stand beside"
    with pytest.raises(FormatError, match="strict"):
        as_jrl(batch, strict=True)
    with pytest.raises(FormatError, match="the key -7; wanted keys from 0"):
        as_jrl(Batch((Variables("se2", np.array([-7]), np.zeros((1, 3))),)))


@pytest.mark.parametrize("ending", GRAPHS)
def test_the_ending_says_the_form_and_what_has_no_place_in_it_is_said(tmp_path: Path, ending: str) -> None:
    graph = read_text(tmp_path, PLANE)
    path = tmp_path / f"b{ending}"
    notes = write_graph(path, graph.batch, log=graph.log)
    form = "jrl" if ending == ".cbor" else ending.removeprefix(".")
    assert read(path).dialect == form
    lost = [
        f"3 {name} left out: {form} has no place to say so" for name in ("ground truth values", "potential outliers")
    ]
    assert [any(note.startswith(each) for note in notes) for each in lost] == [form != "jrl"] * 2
    if form != "jrl":
        with pytest.raises(FormatError, match="strict"):
            write_graph(path, graph.batch, strict=True, log=graph.log)
    with pytest.raises(FormatError, match=r"the ending '\.xyz'; wanted one of \.g2o, \.pyfg, \.jrl"):
        write_graph(tmp_path / "b.xyz", graph.batch)


def test_a_replay_takes_a_late_closure_when_its_entry_comes(tmp_path: Path) -> None:
    """Robot b is joined to a late, by a closure between two poses of long ago."""

    def between(one: int, other: int) -> dict[str, Any]:
        what = {"measurement": {"type": "Pose2", "x": 1, "y": 0, "theta": 0}, "covariance": np.eye(3).ravel().tolist()}
        return {"type": "BetweenFactorPose2", "key1": one, "key2": other, **what}

    def entries(letter: str, *more: dict[str, Any]) -> list[dict[str, Any]]:
        odometry = [between(symbol(letter, n), symbol(letter, n + 1)) for n in range(4)]
        return [{"stamp": T0 + 10 * n, "measurements": [each]} for n, each in enumerate(odometry, 1)] + list(more)

    joined = {"stamp": T0 + 35, "measurements": [between(A1, B1)]}
    closed = {"stamp": T0 + 90, "measurements": [between(A0, A2)]}
    document = {"measurements": {"a": entries("a", closed), "b": entries("b", joined)}}
    graph = read_text(tmp_path, json.dumps(document))
    steps = list(graph.steps())
    names = [{key for group in step.variables for key in group.keys.tolist()} for step in steps]
    a3, a4, b2, b3, b4 = symbol("a", 3), symbol("a", 4), symbol("b", 2), symbol("b", 3), symbol("b", 4)
    assert names == [{A0}, {A1}, {A2}, {a3}, {a4, B0, B1, b2, b3}, {b4}], "b comes with the first pose from 35 on"
    pairs = [[tuple(row) for group in step.factors for row in group.keys.tolist()] for step in steps]
    assert (A1, B1) in pairs[4]
    assert (A0, A2) in pairs[5], "which comes with the last pose"
    assert graph.whole().factor_count == 10
    for group in (group for step in steps for group in step.variables):
        assert group.stamps is not None


def test_a_closure_in_time_comes_with_its_poses(tmp_path: Path) -> None:
    graph = read_text(tmp_path, PLANE)
    names = [{key for group in step.variables for key in group.keys.tolist()} for step in graph.steps()]
    assert [keys & {A0, A1, B0} for keys in names] == [{A0}, {B0}, {A1}], "in the order of time"
