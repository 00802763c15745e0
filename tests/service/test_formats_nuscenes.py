"""The vehicle's poses of nuScenes, ego_pose.json."""

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from factorbus.cli.main import main
from factorbus.formats import FormatError, read
from factorbus.proto.symbols import symbol

# As in v1.0-mini: microseconds, w x y z, and entries in no order.
ENTRIES = [
    {
        "token": "a",
        "timestamp": 1532402927647951,
        "rotation": [0.5, -0.5, 0.5, 0.5],
        "translation": [411.5, 1180.25, 0.0],
    },
    {"token": "b", "timestamp": 1532402927612460, "rotation": [1, 0, 0, 0], "translation": [411.25, 1180.5, 0.0]},
    {"token": "c", "timestamp": 1532402928147847, "rotation": [0.8, 0, 0, 0.6], "translation": [410.0, 1179.0, 1.5]},
]  # fmt: skip


def written(tmp_path: Path, entries: Any, name: str = "ego_pose.json") -> Path:
    (tmp_path / name).write_text(json.dumps(entries, indent=0))
    return tmp_path / name


def changed(**members: Any) -> list[dict[str, Any]]:
    """The entries, of which the last has other members; None takes one away."""
    last = {name: value for name, value in {**ENTRIES[2], **members}.items() if value is not None}
    return [*ENTRIES[:2], last]


@pytest.mark.parametrize("name", ["ego_pose.json", "poses.json", "ego_pose.json.gz"])
def test_poses_are_in_the_order_of_time(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    content = json.dumps(ENTRIES).encode()
    path.write_bytes(gzip.compress(content) if name.endswith(".gz") else content)
    graph = read(path)
    (group,) = graph.batch.variables
    assert (graph.dialect, group.kind, group.fixed, graph.notes) == ("nuscenes", "se3", False, ())
    assert group.keys.tolist() == [symbol("x", n) for n in range(3)]
    assert group.stamps is not None
    assert group.stamps.tolist() == [1532402927612460000, 1532402927647951000, 1532402928147847000]
    np.testing.assert_array_equal(
        group.values,
        [
            [411.25, 1180.5, 0.0, 0.0, 0.0, 0.0, 1.0],
            [411.5, 1180.25, 0.0, -0.5, 0.5, 0.5, 0.5],
            [410.0, 1179.0, 1.5, 0.0, 0.0, 0.6, 0.8],
        ],
    )


def test_entries_of_one_time_are_one_pose(tmp_path: Path) -> None:
    graph = read(written(tmp_path, [*ENTRIES, {**ENTRIES[0], "token": "d"}]))
    assert len(graph.batch.variables[0].keys) == 3
    assert graph.notes == ("1 entry of the time of another left out: they are one pose",)
    moved = read(written(tmp_path, [*ENTRIES, {**ENTRIES[0], "translation": [411.5, 1181.75, 0.0]}]))
    assert moved.notes[1] == "entries of one time are up to 1.5 m apart; the first of them counts"
    np.testing.assert_array_equal(moved.batch.variables[0].values, graph.batch.variables[0].values)


def test_scenes_after_each_other_are_said(tmp_path: Path) -> None:
    later = [{**each, "timestamp": each["timestamp"] + 3_600_000_000} for each in ENTRIES]
    (note,) = read(written(tmp_path, [*later, *ENTRIES])).notes
    assert note.startswith("2 drives, more than 2 s apart in time")


@pytest.mark.parametrize(
    ("entries", "found"),
    [
        ([], "no pose"),
        ({"timestamp": 1}, "an object"),
        (changed(rotation=[1.0, 0.0, 0.0]), r"\[2\].rotation: an array of 3"),
        (changed(rotation=[1.0, 0.5, 0.0, 0.0]), r"\[2\].rotation: a quaternion of norm 1.118"),
        (changed(translation=[1.0, "2", 3.0]), r"\[2\].translation"),
        (changed(translation=None), r"\[2\]: no translation"),
        (changed(timestamp=1.5), r"\[2\].timestamp: 1.5"),
        (changed(timestamp=-1), r"\[2\].timestamp: -1"),
        (changed(timestamp=2**62), "a whole number from 0"),
        ([*ENTRIES, 7], r"\[3\]: 7"),
    ],
)
def test_what_is_no_pose_is_refused_with_its_place(tmp_path: Path, entries: Any, found: str) -> None:
    with pytest.raises(FormatError, match=found):
        read(written(tmp_path, entries), "nuscenes")


def test_other_arrays_of_json_are_no_poses(tmp_path: Path) -> None:
    """calibrated_sensor.json has places on the vehicle, and no times."""
    sensors = [{name: value for name, value in each.items() if name != "timestamp"} for each in ENTRIES]
    with pytest.raises(FormatError, match="unknown record"):
        read(written(tmp_path, sensors, "calibrated_sensor.json"))


@given(content=st.binary(max_size=200), array=st.booleans())
def test_any_bytes_are_read_or_refused(tmp_path_factory: pytest.TempPathFactory, content: bytes, array: bool) -> None:
    file = tmp_path_factory.mktemp("nuscenes") / "ego_pose.json"
    whole = json.dumps(ENTRIES).encode()
    file.write_bytes(whole[: len(content)] + content + whole[len(content) * 2 :] if array else content)
    try:
        graph = read(file, "nuscenes")
    except FormatError:
        return
    assert all(np.isfinite(group.values).all() for group in graph.batch.variables if group.values is not None)


def test_it_is_converted_and_cannot_be_driven(tmp_path: Path) -> None:
    source = written(tmp_path, ENTRIES)
    assert main(["convert", str(source), str(tmp_path / "way.tum")]) == 0
    first = (tmp_path / "way.tum").read_text().splitlines()[0].split()
    assert (first[0], float(first[1])) == ("1532402927.612460000", 411.25)
    with pytest.raises(FormatError, match="a trajectory, which has no measurements"):
        read(source).steps()
