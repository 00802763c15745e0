"""Attaching a part where something goes wrong: no right to insert, a service that is killed, two at the same time."""

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from journalled import Services
from processes import PATIENCE_S, processes
from secured import Secured
from two_parts import SIGMAS, Parts, between_parts, parts

from factorbus.cli.output.exits import REFUSED
from factorbus.client import Map, Unavailable, attach, connect

AGREE = 10  # of the candidates


@pytest.fixture(scope="module")
def both() -> Parts:
    return parts(5, AGREE, 8)


@pytest.fixture(scope="module")
def secured(tmp_path_factory: pytest.TempPathFactory) -> Secured:
    return Secured(tmp_path_factory.mktemp("secured"))


@pytest.fixture
def hub(secured: Secured, tmp_path: Path) -> Iterator[str]:
    """A service with access control that has the map kitchen."""
    with processes(tmp_path) as start:
        yield start(
            "-m", "factorbus.service", "--listen", "tls/127.0.0.1:0", "--zenoh", str(secured.server), "--name", "s1",
            "--create", "kitchen",
        ).ready()[0]  # fmt: skip


def values(of: Map) -> list[bytes]:
    return [g.values.tobytes() for g in of.ask_estimate().variables if g.values is not None]


def is_whole(hall: Map, both: Parts) -> bool:
    """Whether the part is attached; it is so with all that belongs to it, or not at all."""
    found, joined = hall.components(), between_parts(hall)
    held = [dict(each.held) for each in found.listed]
    assert (found.count, joined, held) in ((2, 0, [{"fixed": 1}] * 2), (1, AGREE, [{"fixed": 1}])), found
    assert sum(each.variables for each in found.listed) == len(both.one.steps) + len(both.other.steps)
    return joined == AGREE


def test_who_may_insert_may_attach_and_who_may_only_look_changes_nothing(
    secured: Secured, hub: str, both: Parts
) -> None:
    with (
        connect(hub, client="robot1", zenoh=secured.clients["robot1"], timeout_s=PATIENCE_S) as robots,
        connect(hub, client="wall", zenoh=secured.clients["wall"], timeout_s=3) as viewers,
        robots.map("kitchen", create=False) as kitchen,
        closing(viewers.map("kitchen", create=False, mirror=False)) as seen,
    ):
        both.fill(kitchen)
        kitchen.wait_converged()
        before, revision = values(kitchen), kitchen.stats()["revision"]
        with pytest.raises(Unavailable, match=r"may not insert|nobody replies"):
            attach(seen, "y", both.draft())
        assert not is_whole(kitchen, both)
        assert (values(kitchen), kitchen.stats()["revision"]) == (before, revision)
        assert attach(kitchen, "y", both.draft()).accepted
        assert is_whole(kitchen, both)


def kill_at(running: Services, hall: Map, call: str) -> None:
    """The service is killed when that method of the map is called next, behind what it does, and comes again."""
    asked = getattr(hall, call)

    def killed(*arguments: Any, **options: Any) -> Any:
        setattr(hall, call, asked)
        answer = asked(*arguments, **options)
        running.end(signal.SIGKILL)
        running.start()
        return answer

    setattr(hall, call, killed)


@pytest.mark.parametrize("call", ["graph", "send", "insert"])
def test_a_service_that_is_killed_meanwhile_attaches_once(
    services: Callable[..., Services], tmp_path: Path, both: Parts, call: str
) -> None:
    """Before the insert, while it is on its way, and when it is answered."""
    running = services(tmp_path / "journal")
    with connect(running.start(), client="matcher", timeout_s=PATIENCE_S) as bus, bus.map("hall") as hall:
        both.fill(hall)
        kill_at(running, hall, call)
        joined = attach(hall, "y", both.draft())
        assert joined.accepted
        assert joined.left_out == {"fixed": 1}
        assert is_whole(hall, both)
        hall.wait_converged()
        held = values(hall)
        running.end(signal.SIGKILL)
        running.start()
        assert values(hall) == held
    running.end(signal.SIGTERM)
    line = [sys.executable, "-m", "factorbus.cli", "journal", "verify", "--journal", str(tmp_path / "journal"), "hall"]
    verified = subprocess.run(line, capture_output=True, text=True, timeout=120, check=False)
    assert "all the same to the bit" in verified.stdout, verified.stderr


def test_with_its_client_gone_too_it_is_whole_or_not_at_all(
    services: Callable[..., Services], tmp_path: Path, both: Parts
) -> None:
    """The insert is sent, and both are killed: nobody sends it again."""
    running = services(tmp_path / "journal")
    with connect(running.start(), client="robots", timeout_s=PATIENCE_S) as bus:
        with bus.map("hall") as hall:
            both.fill(hall)
            hall.wait_converged()
        for n in range(4):
            bus.fork("hall", f"hall{n}")
            with bus.map(f"hall{n}", mirror=False) as hall:
                before, send = values(hall), hall.send

                def once(*arguments: Any, of: Map = hall, send: Any = send, **options: Any) -> Any:
                    pending = send(*arguments, **options)
                    running.end(signal.SIGKILL)
                    of.close()  # what is unanswered is given up
                    return pending

                hall.send = once  # type: ignore[method-assign]
                with pytest.raises(Unavailable):
                    attach(hall, "y", both.draft())
            running.start()
            with bus.map(f"hall{n}", create=False) as again:
                if not is_whole(again, both):
                    assert values(again) == before
                    assert attach(again, "y", both.draft()).accepted
                assert is_whole(again, both)


def test_two_processes_at_once(endpoint: str, tmp_path: Path, both: Parts) -> None:
    """One attaches, and the other is refused: the candidates are in the map once."""
    matches = tmp_path / "matches.txt"
    matches.write_text(both.lines())
    with connect(endpoint, client="robots", timeout_s=PATIENCE_S) as bus:
        with bus.map("hall") as hall:
            both.fill(hall)
        for n in range(3):
            bus.fork("hall", f"at-once{n}")
            line = [sys.executable, "-P", "-m", "factorbus.cli", "change", "attach", f"at-once{n}", "y", str(matches)]
            line += ["--connect", endpoint, "--sigmas", ",".join(map(str, SIGMAS))]
            ran = [subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) for _ in range(2)]
            said = [each.communicate(timeout=PATIENCE_S)[1] for each in ran]
            assert sorted(each.returncode for each in ran) == [0, REFUSED], said
            assert any("cannot_merge" in each and "joined to the rest already" in each for each in said), said
            with bus.map(f"at-once{n}", create=False) as hall:
                assert is_whole(hall, both)
                assert np.isfinite(hall.estimate["y10"]).all()
