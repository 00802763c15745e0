"""Clients that follow a part of a map over the bus: a service in a process of its own, clients that come and die."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from interests import held
from processes import PATIENCE_S, Process, processes

from factorbus.client import Bus, Draft, Interest, Map, Refused, connect
from factorbus.client.interest_mirror import InterestMirror
from factorbus.client.link import open_link
from factorbus.client.replies import AnswerReply, Failure, Reply
from factorbus.proto import codec, keys
from factorbus.proto.interest import filter_of
from factorbus.proto.messages import Delta

SIGMAS = (0.1, 0.1, 0.05)
LEASE_S = 2.5  # a client that is alive may have to wait for a core
FOLLOW = """
import sys
from factorbus.client import Interest, connect
bus = connect(sys.argv[1], client="mortal")
joined = bus.map(sys.argv[2], interest=Interest("x"))
print("following", joined.estimate.revision)
sys.stdin.read()
"""


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("interests")
    settings = folder / "service.toml"
    settings.write_text(f"[limits]\ninterests = 4\ninterest_lease_s = {LEASE_S}\n")
    with processes(folder) as start:
        service = start("-m", "factorbus.service", "--listen", "tcp/127.0.0.1:0", "--config", str(settings))
        yield service.ready()[0]


@pytest.fixture
def bus(endpoint: str) -> Iterator[Bus]:
    with connect(endpoint, client="driver", timeout_s=PATIENCE_S) as opened:
        yield opened


@pytest.fixture
def viewer(endpoint: str) -> Iterator[Bus]:
    with connect(endpoint, client="viewer", timeout_s=PATIENCE_S) as opened:
        yield opened


def drive(joined: Map, first: int, count: int, letter: str = "x") -> int:
    """Poses one behind the other, one insert each; the revision of the last."""
    revision = 0
    for i in range(first, first + count):
        draft = Draft().se2(f"{letter}{i}", None if i else (0, 0, 0), fixed=not i)
        if i:
            draft.between_se2(f"{letter}{i - 1}", f"{letter}{i}", (1, 0, 0.02), sigmas=SIGMAS)
        revision = joined.insert(draft).revision
    return revision


def close_loop(joined: Map, a: str, b: str) -> int:
    return joined.insert(Draft().between_se2(a, b, (0.5, 0.5, 0.1), sigmas=SIGMAS)).revision


def eventually(true: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, "it never came"
        threading.Event().wait(0.05)  # a service's statistics tell nobody that they have changed


def follow(part: Map, revision: int) -> None:
    """The mirror is at this revision, and what it follows of it has come: some of it may wait for the next period."""
    part.estimate.wait_for(revision)
    eventually(lambda: not part.estimate.waiting)


def test_what_a_mirror_has_is_the_part_of_the_estimate_at_its_revision(bus: Bus, viewer: Bus) -> None:
    interest = Interest(letters="x", box=(2.0, -3.0, 12.0, 5.0), period_ms=20)
    with bus.map("part") as whole, viewer.map("part", interest=interest) as part:
        history: dict[int, object] = {0: {}}
        seen: list[tuple[int, object]] = []

        def note(delta: Delta) -> None:
            history[delta.revision] = held(filter_of(interest).pick(whole.estimate.snapshot().variables()))

        def see(delta: Delta) -> None:
            seen.append((delta.revision, held(part.estimate.snapshot().variables())))

        whole.estimate.on_delta(note)
        part.estimate.on_delta(see)
        drive(whole, 0, 40)
        drive(whole, 0, 20, "y")
        for i in range(15, 40, 3):  # the mirror has each before the next, however late its messages are
            part.estimate.wait_for(close_loop(whole, f"x{i}", f"x{i - 9}"))
        whole.wait_converged()
        part.estimate.wait_for(whole.estimate.revision)
        part.wait_converged()
        follow(part, whole.estimate.revision)
        assert len(seen) > 5
        assert all(history[revision] == values for revision, values in seen)
        asked = viewer.map("part", mirror=False).ask_estimate(interest=interest)
        assert held(asked.variables) == held(part.estimate.snapshot().variables())
        assert 0 < len(part.estimate) < 40
        assert part.estimate.received_bytes < 0.5 * whole.estimate.received_bytes


def test_a_bound_is_kept_and_the_mirror_says_what_waits(bus: Bus, viewer: Bus) -> None:
    with bus.map("bound") as whole:
        drive(whole, 0, 150)
        began, interest = time.monotonic(), Interest(period_ms=50, bytes_per_s=1000)
        with viewer.map("bound", interest=interest) as part:
            assert part.estimate.waiting > 0
            assert "x149" in part.estimate, "newest first"
            close_loop(whole, "x149", "x3")
            revision = close_loop(whole, "x140", "x10")
            eventually(lambda: not part.estimate.waiting and part.estimate.revision >= revision)
            whole.wait_converged()
            part.wait_converged()
            eventually(lambda: not part.estimate.waiting)
            took = time.monotonic() - began
            (row,) = (row for row in part.stats()["interests"] if row["bytes_per_s"] == 1000)
            assert row["bytes"] <= 1000 * took + 2 * 1000
            assert row["bytes"] > 150 * 32
            np.testing.assert_array_equal(part.estimate.columns("se2")[1], whole.estimate.columns("se2")[1])


def test_a_client_that_is_killed_is_forgotten_after_its_lease(
    bus: Bus, endpoint: str, spawn: Callable[..., Process], tmp_path: Path
) -> None:
    with bus.map("mortal") as whole:
        drive(whole, 0, 5)
        follower = spawn("-c", FOLLOW, endpoint, "mortal")
        follower.line("following")
        assert len(whole.stats()["interests"]) == 1
        follower.signal(signal.SIGKILL)
        eventually(lambda: whole.stats()["interests"] == [])
        drive(whole, 5, 3)


def test_one_that_lives_is_not(bus: Bus, viewer: Bus) -> None:
    with bus.map("alive") as whole, viewer.map("alive", interest=Interest("x", period_ms=10)) as part:
        drive(whole, 0, 3)
        threading.Event().wait(2 * LEASE_S)  # nothing happens, which is what is tried
        assert not part.estimate.stale
        follow(part, drive(whole, 3, 3))
        assert len(part.estimate) == 6


def test_what_a_part_does_not_have_is_not_said_to_be_missing_in_the_map(bus: Bus, viewer: Bus) -> None:
    with bus.map("lacking") as whole, viewer.map("lacking", interest=Interest("q", period_ms=10)) as part:
        drive(whole, 0, 3)
        for look in (lambda: part.estimate["x0"], lambda: part.estimate.columns("se2")):
            with pytest.raises(KeyError, match="in the part of map 'lacking' that its interest mirrors"):
                look()


def test_a_map_that_is_made_anew_is_followed(bus: Bus, viewer: Bus) -> None:
    with bus.map("anew", mirror=False) as whole, viewer.map("anew", interest=Interest("x", period_ms=10)) as part:
        drive(whole, 0, 9)
        epoch = part.estimate.epoch
        bus.drop("anew")
        whole.rejoin()
        drive(whole, 0, 3)
        eventually(lambda: part.estimate.epoch != epoch and len(part.estimate) == 3)


def test_a_removed_variable_is_let_go_of(bus: Bus, viewer: Bus) -> None:
    from factorbus.client import Changes

    with bus.map("removed") as whole, viewer.map("removed", interest=Interest("x", period_ms=10)) as part:
        follow(part, drive(whole, 0, 6))  # the mirror has x5, which is to leave it
        gone: list[Delta] = []
        part.estimate.on_delta(gone.append)
        revision = whole.change(Changes().remove_variables("x5")).revision
        follow(part, revision)
        assert sorted(key for _, key in held(part.estimate.snapshot().variables())) == [
            key for _, key in sorted(held(whole.ask_estimate().variables))
        ]
        assert "x5" not in part.estimate
        assert gone[-1].previous == 0, "who only hears of what is new is given everything"


def test_more_interests_than_the_limit_are_refused_by_name(bus: Bus, viewer: Bus) -> None:
    opened = [viewer.map("many", interest=Interest(letter)) for letter in "abcd"]
    with pytest.raises(Refused, match=r"limits\.interests") as refused:
        viewer.map("many", interest=Interest("e"))
    assert refused.value.code == "too_large"
    for each in opened:
        each.close()


def test_a_mirror_of_all_and_one_of_a_part_are_both_mirrors(bus: Bus) -> None:
    with bus.map("both", interest=Interest()) as part:
        assert isinstance(part.estimate, InterestMirror)
        follow(part, drive(part, 0, 3))
        assert part.estimate["x2"].shape == (3,)


def test_stats_and_top_say_what_each_channel_carries(bus: Bus, viewer: Bus, endpoint: str) -> None:
    with (
        bus.map("told") as whole,
        viewer.map("told", interest=Interest("x", box=(0, 0, 9, 9), bytes_per_s=5000)) as part,
    ):
        follow(part, drive(whole, 0, 4))
        said = command("stats", "told", endpoint)
        assert re.search(r"interest in told.*x; box 0 0 9 9, every 100 ms, at most 5,000 bytes a second: ", said)
        rows = json.loads(command("top", "--once", "--json", endpoint))["interests"]
        (row,) = (each for each in rows if each["map"] == "told")  # those of other maps end a little later
        assert (row["letters"], row["waiting"]) == (["x"], 0)
        assert row["bytes"] > 0
        assert "box 0 0 9 9" in command("top", "--once", endpoint)


def command(*words: str) -> str:
    ran = subprocess.run(
        [sys.executable, "-m", "factorbus.cli", *words[:-1], "--connect", words[-1]],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        env=os.environ | {"COLUMNS": "200"},
    )
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


HOSTILE = {
    "no message": (b"\xc1", "bad_message"),
    "an array": (b"\x90", "bad_message"),
    "letters of numbers": (codec.encode_map({"letters": [1]}), "bad_message"),
    "a long letter": (codec.encode_map({"letters": ["xx"]}), "bad_option"),
    "a kind that is none": (codec.encode_map({"kinds": ["se9"]}), "unknown_kind"),
    "half a box": (codec.encode_map({"box": b"\0" * 24}), "bad_message"),
    "a box of NaN": (codec.encode_map({"box": np.full(4, np.nan).tobytes()}), "bad_option"),
    "a box inside out": (codec.encode_map({"box": np.array([1.0, 0, 0, 1]).tobytes()}), "bad_option"),
    "no period": (codec.encode_map({"period_ms": 0}), "bad_option"),
    "a period of ages": (codec.encode_map({"period_ms": 2**62}), "bad_option"),
    "a bound of nothing": (codec.encode_map({"bytes_per_s": 1}), "bad_option"),
    "a number below 0": (codec.encode_map({"number": -1}), "bad_message"),
    "letters without end": (codec.encode_map({"letters": ["x"] * 300}), "too_large"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_a_question_that_is_none_is_refused_whole(endpoint: str, bus: Bus, what: str) -> None:
    payload, code = HOSTILE[what]
    bus.create("hostile")
    link = open_link([endpoint], PATIENCE_S, {})
    try:
        came: list[Reply] = []
        done = threading.Event()

        def hear(reply: Reply) -> None:
            came.append(reply)
            done.set()

        link.ask(keys.ask_key("hostile", "interest"), payload, PATIENCE_S, hear)
        assert done.wait(PATIENCE_S)
        (reply,) = came
        assert isinstance(reply, Failure)
        assert codec.decode_problem(reply.payload).code == code
    finally:
        link.close()
    assert bus.map("hostile", mirror=False).stats()["interests"] == []


def test_a_stranger_with_numbers_of_its_own_gets_all_and_harms_nobody(endpoint: str, bus: Bus) -> None:
    with bus.map("stranger") as whole:
        drive(whole, 0, 4)
        link = open_link([endpoint], PATIENCE_S, {})
        try:
            for asked in ({"stream": 5, "number": 2**62}, {"number": 7}, {}):
                done: list[Reply] = []
                event = threading.Event()
                payload = codec.encode_map({"following": True, **asked})
                link.ask(
                    keys.ask_key("stranger", "interest"),
                    payload,
                    PATIENCE_S,
                    lambda reply, done=done, event=event: (done.append(reply), event.set()),
                )
                assert event.wait(PATIENCE_S)
                (reply,) = done
                assert isinstance(reply, AnswerReply)
                answer = codec.decode_map(reply.payload)
                assert answer["whole"]
                assert len(answer["variables"][0]["keys"]) == 4 * 8
        finally:
            link.close()


def test_a_mirror_follows_on_after_its_service_was_killed(tmp_path: Path) -> None:
    interest = Interest(letters="x", kinds="se2", box=(-1.0, -1.0, 12.0, 5.0), period_ms=20)
    with processes(tmp_path) as start:
        serve = ["-m", "factorbus.service", "--journal", str(tmp_path / "journal"), "--listen"]
        service = start(*serve, "tcp/127.0.0.1:0")
        (endpoint,) = service.ready()
        with (
            connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus,
            connect(endpoint, client="looking", timeout_s=PATIENCE_S) as looking,
            bus.map("killed") as whole,
            looking.map("killed", interest=interest) as part,
        ):
            for begun in (0, 20):
                part.estimate.wait_for(drive(whole, begun, 20))
                service.signal(signal.SIGKILL)
                service.wait()
                service = start(*serve, endpoint)
                service.ready()
            close_loop(whole, "x39", "x8")
            whole.wait_converged()
            part.estimate.wait_for(whole.estimate.revision)
            assert 0 < len(part.estimate) < 40
            assert held(part.estimate.snapshot().variables()) == held(
                filter_of(interest).pick(whole.estimate.snapshot().variables())
            )
