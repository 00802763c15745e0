"""A map that begins as another one is: the same to the bit, on its own from then on, and kept where maps are kept."""

import asyncio
import json
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zenoh
from bare import Bare
from journalled import Services, Stream, drafts, rows
from processes import PATIENCE_S, Process

from factorbus.client import Changes, Draft, Map, Refused, aio, connect
from factorbus.journal.store import open_store
from factorbus.proto import codec, keys
from factorbus.proto.problems import BadName, UnknownMap
from factorbus.service.config import Limits
from factorbus.service.journal.library import make_map_solver
from factorbus.service.questions.answers import Copied, Question

SIGMAS = (0.1, 0.1, 0.02)


def everything(joined: Map) -> tuple[Any, ...]:
    """All that a map has, but its name and epoch."""
    graph = joined.graph()
    variables = [
        (g.kind, g.fixed, *(None if c is None else c.tobytes() for c in (g.keys, g.values, g.stamps)))
        for g in graph.batch.variables
    ]
    factors = [
        (
            g.kind,
            g.loss,
            *(None if c is None else c.tobytes() for c in (g.scale, g.ids, g.keys, g.measured, g.information)),
        )
        for g in graph.batch.factors
    ]
    return graph.revision, joined.mode, variables, factors, joined.chi2().chi2


def prepared(joined: Map) -> None:
    """Poses and landmarks, with a loss, a weight, a second fixed pose, and ids with gaps."""
    for batch in drafts(40):
        joined.insert(batch)
    joined.insert(Draft().point2("l1").landmark_se2("x5", "l1", (2, 1), sigmas=(0.1, 0.1)))
    joined.insert(Draft().landmark_se2("x25", "l1", (2, 1.5), sigmas=(0.1, 0.1), loss=("huber", 1.0)))
    joined.change(Changes().remove_factors([30, 22]).loss([24], "dcs", 1.5).weigh([7], 0.5).fix("x9"))
    joined.wait_converged()


def later(n: int) -> Draft:
    return Draft().se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", (1, 0.01, 0.3), sigmas=SIGMAS).between_se2(
        f"x{n - 21}", f"x{n}", (0.1, 0, 0), sigmas=SIGMAS
    )  # fmt: skip


@pytest.mark.parametrize("mode", ["bayes-tree", "inc-l", "all-batch"])
def test_a_fork_is_the_same_to_the_bit_and_goes_on_by_itself(endpoint: str, mode: str) -> None:
    name, what_if = f"original-{mode}", f"what-if-{mode}"
    with connect(endpoint, client="forker", timeout_s=60) as bus, bus.map(name, mode) as original:
        prepared(original)
        before = everything(original)
        row = bus.fork(name, what_if)
        assert (row.name, row.mode, row.revision) == (what_if, original.mode, before[0])
        assert row.epoch != original.epoch
        with bus.map(what_if, create=False) as fork:
            assert everything(fork) == before == everything(original)
            for n in (40, 41, 42):
                assert original.insert(later(n)).first_factor == fork.insert(later(n)).first_factor
            for each in (fork, original):
                each.wait_converged()
            assert everything(fork) == everything(original), "the same inserts lead to the same bits"
            then = everything(original)
            fork.change(Changes().remove_variables("l1").weigh([5], 0.1), settle=True)
            fork.insert(Draft().between_se2("x0", "x30", (1, 5, 0), sigmas=SIGMAS), settle=True)
            fork.estimate.wait_for(fork.stats()["revision"])
            assert "l1" not in fork.estimate
            assert everything(original) == then, "what happens in one does not touch the other"
            assert not np.array_equal(fork.estimate["x30"], original.estimate["x30"])
        bus.drop(what_if)
        assert everything(original) == then
        assert original.insert(later(43)).revision == then[0] + 1
        assert what_if not in [each.name for each in bus.maps()]


def test_what_cannot_be_forked_is_refused_and_changes_nothing(
    endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    settings = tmp_path / "service.toml"
    settings.write_text('maps = "lab-*"\nwarm = false\n[limits]\nmaps = 2\n')
    small = spawn("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings)).ready()[0]
    with connect(small, client="forker", timeout_s=60) as bus, bus.map("lab-a") as original:
        for batch in drafts(5):
            original.insert(batch)
        before = everything(original)
        for target, code in (("lab-a", "map_exists"), ("hall", "kept_elsewhere")):
            with pytest.raises(Refused) as refused:
                bus.fork("lab-a", target)
            assert refused.value.code == code
        for source in ("lab-x", "hall"):
            with pytest.raises(UnknownMap):
                bus.fork(source, "lab-b")
        with pytest.raises(Refused, match="'hall' is not one of them") as refused:
            bus.create("hall")
        assert refused.value.code == "unknown_map"
        with pytest.raises(BadName):
            bus.fork("lab-a", "no/name")
        first = bus.fork("lab-a", "lab-b")
        with pytest.raises(Refused) as refused:
            bus.fork("lab-a", "lab-c")
        assert refused.value.code == "too_large"
        assert [each.name for each in bus.maps()] == ["lab-a", "lab-b"]
        assert [each for each in bus.maps() if each.name == "lab-b"] == [replace(first, protocol={})]
        assert everything(original) == before
        bus.drop("lab-b")
        assert bus.fork("lab-a", "lab-b").epoch != first.epoch


def test_who_asks_again_is_answered_again(endpoint: str) -> None:
    config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
    with connect(endpoint, client="forker", timeout_s=60) as bus, zenoh.open(config) as session:
        bus.create("asked-again")
        asker, asked = Bare(session), {"map": "asked-again", "as": "answered-again", "request": 4711}

        def ask(**other: Any) -> dict[str, Any]:
            said = asker.ask(f"{keys.PREFIX}/admin/fork", codec.encode_map({**asked, **other}))
            return codec.decode_map(said) if isinstance(said, bytes) else {"code": said and said.code}

        row = ask()
        assert ask() == row
        assert ask(request=4712)["code"] == "map_exists"
        assert ask(request=0)["code"] == "map_exists"
        assert ask(request=-1)["code"] == ask(**{"as": None})["code"] == ask(map=7)["code"] == "bad_message"
        assert ask(**{"as": "a b"})["code"] == "bad_name"
        bus.drop("answered-again")
        assert ask()["epoch"] != row["epoch"], "it is gone, so this makes it anew"


@pytest.mark.parametrize("durability", ["commit", "group"])
def test_a_fork_is_there_after_a_kill_bit_for_bit(
    services: Callable[..., Services], tmp_path: Path, durability: str
) -> None:
    journal, batches = tmp_path / "journal", drafts(160)
    running = services(journal, f'durability="{durability}"', "checkpoint_s=0.001")
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("hall", window=8) as hall:
        stream = Stream(hall, batches)
        stream.start()
        stream.allow(len(batches))
        stream.wait_for(60)
        row = bus.fork("hall", "what-if")  # in the middle of it
        stream.wait_for(len(batches))
        stream.join(PATIENCE_S)
        with bus.map("what-if", create=False) as fork:
            assert fork.stats()["revision"] >= row.revision >= 1
            if durability == "commit":
                count = len(rows(fork.ask_estimate().variables))
                fork.insert(Draft().se2("y1").between_se2("x50", "y1", (0, 1, 0), sigmas=SIGMAS))
                fork.change(Changes().fix("x40").remove_variables(f"x{count - 1}"))
            fork.wait_converged()
            before, epoch = everything(fork), fork.epoch
    running.end(signal.SIGKILL)
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus:
        with bus.map("what-if", create=False) as fork:
            assert everything(fork) == before
            assert (fork.epoch == epoch) == (durability == "commit")
            fork.insert(Draft().se2("z1").between_se2("x45", "z1", (0, 1, 0), sigmas=SIGMAS))
            fork.wait_converged()
            again = bus.fork("what-if", "what-if-2")  # a fork of a fork that was opened
            with bus.map("what-if-2", create=False) as second:
                assert everything(second) == everything(fork)
                assert again.revision == fork.estimate.revision > before[0]
        (journal / "taken").mkdir()
        (journal / "taken" / "something").touch()
        with pytest.raises(Refused) as refused:
            bus.fork("hall", "taken")
        assert refused.value.code == "map_exists"
        assert not list(journal.glob(".making-*"))
        bus.drop("what-if")
        with bus.map("hall", create=False) as hall:
            assert len(rows(hall.ask_estimate().variables)) <= len(batches)
    assert not (journal / "what-if").exists()
    running.end(signal.SIGTERM)
    for name in ("hall", "what-if-2"):
        store = open_store(journal / name, read_only=True)
        assert (store.header().map, list(store.check())) == (name, [])
        store.close()
    done = command("journal", "verify", "what-if-2", "--journal", str(journal))
    assert "all the same to the bit" in done, done


def test_a_fork_for_which_there_is_no_memory_takes_none() -> None:
    folder = make_map_solver("bayes-tree", {}, 7, Limits())

    def copied(room: int) -> Copied:
        taken = folder.snapshot([Question("copy", ask=SimpleNamespace(room=room))]).copied
        assert taken is not None
        return taken

    assert copied(0).bytes > 0
    assert copied(0).state is None
    assert copied(1 << 40).state is not None


def test_asyncio_and_the_command_line_fork(endpoint: str) -> None:
    async def run() -> int:
        async with aio.connect(endpoint, client="aio", timeout_s=60) as bus, bus.map("forked-by-aio") as joined:
            for batch in drafts(3):
                await joined.insert(batch)
            return (await bus.fork("forked-by-aio", "by-aio")).variables

    assert asyncio.run(run()) == 3
    told = json.loads(command("change", "fork", "by-aio", "by-hand", "--connect", endpoint, "--json"))
    assert (told["name"], told["variables"], told["factors"]) == ("by-hand", 3, 2)
    said = command("change", "fork", "by-aio", "third", "--connect", endpoint)
    assert "third begins at revision 3 of by-aio" in " ".join(said.split())
    assert "map_exists" in command("change", "fork", "by-aio", "third", "--connect", endpoint, code=5)


def command(*arguments: str, code: int = 0) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == code, done.stdout + done.stderr
    return done.stdout + done.stderr
