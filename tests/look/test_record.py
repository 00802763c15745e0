"""`factorbus record`: what is in the file, read by MCAP's own reader and the schemas it carries."""

import json
import signal
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from processes import Process

from factorbus.cli.driving.columns import merged
from factorbus.cli.main import main
from factorbus.cli.output.exits import FAILED, OK
from factorbus.client import connect
from factorbus.proto.messages import Delta, Factors, Variables
from factorbus.proto.stamps import NO_STAMP
from factorbus.proto.symbols import parse_symbol
from factorbus.simulate import city_trees

pytest.importorskip("foxglove")

from factorbus.viz.map_follower import Look
from factorbus.viz.mcap import Recording


def messages(path: Path) -> tuple[dict[str, list[Any]], dict[str, str]]:
    """topic → messages, topic → schema."""
    found: dict[str, list[Any]] = defaultdict(list)
    schemas: dict[str, str] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            schemas[channel.topic] = schema.name
            if channel.message_encoding == "json":
                found[channel.topic].append(json.loads(message.data))
            else:
                decode = DecoderFactory().decoder_for(channel.message_encoding, schema)
                assert decode is not None
                found[channel.topic].append(decode(message.data))
    return found, schemas


def rows_of(numbers: Sequence[float], count: int) -> list[list[float]]:
    """count rows of equal length, one after another."""
    return np.array(numbers).reshape(count, -1).tolist()


T0 = 1_403_636_579_763_555_584


def stamped(group: Variables, n: int) -> Variables:
    """Of the n-th step; of a pose, but for every fifth."""
    return group._replace(stamps=np.array([T0 + n])) if group.kind == "se2" and n % 5 != 2 else group


def test_a_recording_has_every_estimate_and_every_factor(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    steps = list(city_trees(poses=120, seed=5))
    timed = [step.batch._replace(variables=tuple(stamped(group, n) for group in step.batch.variables))
             for n, step in enumerate(steps)]  # fmt: skip
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("taped") as joined:
        for batch in timed[:40]:
            joined.insert(batch)
        path = tmp_path / "tape.mcap"
        recorder = spawn(
            "-m", "factorbus.cli", "record", "taped", "--connect", endpoint, "--out", str(path), "--every", "0.1"
        )
        assert recorder.ready() == [str(path)]
        for batch in timed[40:]:
            joined.insert(batch)
        joined.wait_converged(60)
        last, graph = joined.estimate.snapshot(), joined.graph().batch
        recorder.signal(signal.SIGINT)
        assert recorder.wait() == OK
    found, schemas = messages(path)
    assert schemas == {
        "/tf": "foxglove.FrameTransform", "/map/scene": "foxglove.SceneUpdate", "/map/poses": "foxglove.PosesInFrame",
        "/map/step": "factorbus.Step", "/map/delta": "factorbus.Delta", "/map/factors": "factorbus.Factors",
    }  # fmt: skip
    # Replaying the deltas gives the estimate at the end, bit for bit.
    estimate, stamps, revision = {}, {}, 0
    for delta in found["/map/delta"]:
        assert delta.previous in (0, revision)
        revision = delta.revision
        for group in delta.variables:
            estimate |= dict(zip(group.keys, rows_of(group.values, len(group.keys)), strict=True))
            stamps |= dict(zip(group.keys, group.stamps, strict=False))
            assert group.width * len(group.keys) == len(group.values)
    wanted = {
        key: value.tolist()
        for keys, values in last.columns.values()
        for key, value in zip(keys.tolist(), values, strict=True)
    }
    assert (revision, estimate) == (last.revision, wanted)
    known = {key: stamp for key, stamp in stamps.items() if stamp != NO_STAMP}
    assert known == {parse_symbol(f"x{n}"): T0 + n for n in range(120) if n % 5 != 2}
    # Every factor once, in order.
    for group in graph.factors:
        mine = [each for each in found["/map/factors"] if each.kind == group.kind]
        assert {each.arity for each in mine} == {group.keys.shape[1]}
        assert [key for each in mine for key in each.keys] == group.keys.ravel().tolist()
        assert [number for each in mine for number in each.measured] == group.measured.ravel().tolist()
        assert [number for each in mine for number in each.information] == group.information.ravel().tolist()
    assert sum(len(group.keys) for group in graph.factors) == merged(step.batch for step in steps).factor_count
    chi2 = [step["chi2"] for step in found["/map/step"] if "chi2" in step]
    assert len(chi2) >= 80, "of each insert, and of further steps"
    # What is drawn is what is so.
    scene = {entity.id: entity for entity in found["/map/scene"][-1].entities}
    line = np.array([(p.x, p.y) for p in scene["trajectory x"].lines[0].points])
    np.testing.assert_array_equal(line, last.columns["se2"][1][:, :2])
    assert len(scene["landmarks"].spheres) == len(last.columns["point2"][0])
    pose = found["/tf"][-1]
    assert (pose.parent_frame_id, pose.child_frame_id) == ("map", "x")
    assert (pose.timestamp.seconds, pose.timestamp.nanos) == divmod(T0 + 119, 10**9), "when the pose was"
    assert [pose.translation.x, pose.translation.y] == last.columns["se2"][1][-1, :2].tolist()
    assert len(found["/map/poses"][-1].poses) == 120


@pytest.mark.parametrize(
    ("stamp", "told"), [(NO_STAMP, 7), (-1, 7), (0, 0), (2**32 * 10**9 - 1, 2**32 * 10**9 - 1), (2**32 * 10**9, 7)]
)
def test_a_transform_has_the_time_of_its_pose_where_there_is_a_place_for_it(
    tmp_path: Path, stamp: int, told: int
) -> None:
    poses = Variables("se2", np.array([parse_symbol("x1")]), np.zeros((1, 3)), False, np.array([stamp]))
    with Recording(tmp_path / "one.mcap") as recording:
        recording.take(Look(1, 1, (poses,), (), (), 1, False), now_ns=7)
    found, _ = messages(tmp_path / "one.mcap")
    (transform,) = found["/tf"]
    assert (transform.timestamp.seconds, transform.timestamp.nanos) == divmod(told, 10**9)


def test_a_recording_is_small_and_smaller_without_numbers(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    poses, sizes = Variables("se2", np.arange(1000), rng.normal(size=(1000, 3))), {}
    keys, z, information = np.arange(1000).reshape(500, 2), rng.normal(size=(500, 3)), rng.normal(size=(500, 6))
    factors = Factors("between_se2", keys, z, information)
    for with_deltas in (True, False):
        path = tmp_path / f"{with_deltas}.mcap"
        with Recording(path, with_deltas) as recording:
            recording.take(Look(1, 1, (poses,), (Delta(1, 1, 0, (poses,)),), (factors,), 1, False), now_ns=7)
        sizes[with_deltas] = path.stat().st_size
        found, _ = messages(path)
        assert ("/map/delta" in found, "/map/factors" in found) == (with_deltas, with_deltas)
        assert "/map/step" in found
    numbers = 8 * (poses.keys.size + 3000 + keys.size + z.size + information.size)
    assert sizes[True] - sizes[False] < 1.1 * numbers


def test_a_recording_never_replaces_a_file(endpoint: str, tmp_path: Path, capsys) -> None:
    there = tmp_path / "there.mcap"
    there.write_text("mine")
    assert main(["record", "nowhere", "--connect", endpoint, "--out", str(there)]) == FAILED
    assert "is there already" in capsys.readouterr().err
    assert there.read_text() == "mine"


def test_a_map_that_is_yet_to_come_is_waited_for(endpoint: str, spawn: Callable[..., Process], tmp_path: Path) -> None:
    new = tmp_path / "new.mcap"
    waiting = spawn("-m", "factorbus.cli", "record", "nowhere", "--connect", endpoint, "--out", str(new))
    waiting.said("there is no map 'nowhere' here;")
    waiting.signal(signal.SIGINT)
    assert waiting.wait() == OK
    assert not new.exists()
