"""Before the kernel would end the process, inserts are refused and say why; what is there can be asked and dropped."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bare import INFORMATION
from process_memory import resident
from processes import Process

from factorbus.client import connect
from factorbus.client.map import Map
from factorbus.proto.messages import Batch, Factors, Variables
from factorbus.proto.problems import Refused
from factorbus.service.process import memory

Spawn = Callable[..., Process]
POSES = 5000
ROOM = 120 << 20


def chunk(first: int) -> Batch:
    """A number of poses more, at rest where odometry says."""
    own = np.arange(first, first + POSES)
    edges = np.stack([own - 1, own], axis=1)[first == 0 :]
    measured = np.tile([1.0, 0, 0], (len(edges), 1))
    held = Factors("prior_se2", own[:1, None], np.array([[float(first), 0, 0]]), np.array([INFORMATION]))
    return Batch(
        (Variables("se2", own, np.stack([own, 0 * own, 0 * own], axis=1).astype(float)),),
        (held, Factors("between_se2", edges, measured, np.tile(INFORMATION, (len(edges), 1)))),
    )


def fill(driven: Map) -> tuple[int, Refused]:
    """Insert until refused; how many chunks went in, and the refusal."""
    for n in range(200):
        try:
            driven.insert(chunk(n * POSES))
        except Refused as refused:
            return n, refused
    raise AssertionError("a million poses, and no refusal")


def test_it_refuses_before_the_limit_and_takes_again_after_a_drop(tmp_path: Path, spawn: Spawn) -> None:
    probe = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0")
    with connect(probe.ready()[0], timeout_s=60) as bus:
        limit = bus.stats()[0]["memory"]["resident_bytes"] + ROOM
    probe.end()
    settings = tmp_path / "serve.toml"
    settings.write_text(f"[limits]\nmemory_bytes = {limit}\n")
    service = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings))
    with connect(service.ready()[0], timeout_s=120) as bus, bus.map("first", mirror=False) as first:
        taken, refused = fill(first)
        assert (refused.code, refused.detail["limit"]) == ("out_of_memory", limit)
        assert "memory_bytes" in refused.message
        with pytest.raises(Refused) as no_copy:
            bus.fork("first", "copy")
        assert no_copy.value.code == "out_of_memory"
        stats = bus.stats()[0]
        assert resident(stats["pid"]) < limit / 0.8, "by default the limit leaves a fifth for a step under way"
        assert resident(stats["pid"]) > limit - ROOM // 2, "not long before, either"
        assert stats["alive"]
        assert stats["ready"]
        assert stats["maps"][0]["refusals"] == {"out_of_memory": 1}
        assert sum(len(group.keys) for group in first.ask_estimate().variables) == taken * POSES
        before = resident(stats["pid"])
        for count, code in ((1000, "out_of_memory"), (8000, "too_large"), (1_000_000, "too_large")):
            with pytest.raises(Refused) as no_room:
                first.uncertainty.joint(np.arange(count) % 3000)  # keys, some of them again and again
            assert no_room.value.code == code
            assert no_room.value.detail["size"] > no_room.value.detail["limit"]
        assert resident(stats["pid"]) < before + (64 << 20), "nothing was allocated for what is refused"
        assert first.uncertainty.joint([0, 1]).shape == (6, 6)
        bus.drop("first")
        with bus.map("second", mirror=False) as second:
            again, _ = fill(second)
        assert again > taken // 2, "what was dropped makes room"


@pytest.mark.parametrize("version", [1, 2])
def test_the_limit_of_a_control_group_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: int) -> None:
    (tmp_path / "max").write_text("max\n")
    (tmp_path / "own").write_text(f"{1 << 28}\n")
    files = [tmp_path / "absent", tmp_path / "max", tmp_path / "own"]
    monkeypatch.setattr(memory, "limit_files", lambda *_: files[: version + 1])
    assert memory.available() == (1 << 28 if version == 2 else memory.os.sysconf("SC_PHYS_PAGES") * 4096)
    held = memory.MemoryLimit(0)
    assert held.limit == int(0.8 * memory.available())
    held.close()
