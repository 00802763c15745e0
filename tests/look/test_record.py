"""`factorbus record`: what is in the file, read by MCAP's own reader and the schemas it carries."""

import json
import signal
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from processes import Process

from factorbus.cli.columns import merged
from factorbus.cli.exits import FAILED, OK
from factorbus.cli.main import main
from factorbus.client import connect
from factorbus.proto.symbols import format_symbol, parse_symbol
from factorbus.simulate import city_trees

pytest.importorskip("foxglove")


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


def test_a_recording_has_every_estimate_and_every_factor(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    steps = list(city_trees(poses=120, seed=5))
    with connect(endpoint, client="robot") as bus, bus.map("taped") as joined:
        for step in steps[:40]:
            joined.insert(step.batch)
        path = tmp_path / "tape.mcap"
        recorder = spawn(
            "-m", "factorbus.cli", "record", "taped", "--connect", endpoint, "--out", str(path), "--every", "0.1"
        )
        assert recorder.ready() == [str(path)]
        for step in steps[40:]:
            joined.insert(step.batch)
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
    estimate, revision = {}, 0
    for delta in found["/map/delta"]:
        assert delta["previous"] in (0, revision)
        revision = delta["revision"]
        for group in delta["variables"]:
            estimate |= dict(zip(group["keys"], group["values"], strict=True))
    wanted = {
        format_symbol(key): value.tolist()
        for keys, values in last.columns.values()
        for key, value in zip(keys.tolist(), values, strict=True)
    }
    assert (revision, estimate) == (last.revision, wanted)
    # Every factor once, in order.
    for group in graph.factors:
        mine = [each for each in found["/map/factors"] if each["kind"] == group.kind]
        rows = [[parse_symbol(key) for key in row] for each in mine for row in each["keys"]]
        assert rows == group.keys.tolist()
        assert [row for each in mine for row in each["measured"]] == group.measured.tolist()
        assert [row for each in mine for row in each["information"]] == group.information.tolist()
    assert sum(len(group.keys) for group in graph.factors) == merged(step.batch for step in steps).factor_count
    chi2 = [step["chi2"] for step in found["/map/step"] if "chi2" in step]
    assert len(chi2) == 80
    # What is drawn is what is so.
    scene = {entity.id: entity for entity in found["/map/scene"][-1].entities}
    line = np.array([(p.x, p.y) for p in scene["trajectory x"].lines[0].points])
    np.testing.assert_array_equal(line, last.columns["se2"][1][:, :2])
    assert len(scene["landmarks"].spheres) == len(last.columns["point2"][0])
    pose = found["/tf"][-1]
    assert (pose.parent_frame_id, pose.child_frame_id) == ("map", "x")
    assert [pose.translation.x, pose.translation.y] == last.columns["se2"][1][-1, :2].tolist()
    assert len(found["/map/poses"][-1].poses) == 120


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
