"""Front ends, viewers and a service as processes of their own."""

import hashlib
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
from bare import bare
from processes import PATIENCE_S, Process, within_patience

from factorbus.client import Draft, connect
from factorbus.proto import codec
from factorbus.proto.messages import Estimate

HERE = Path(__file__).parent
Spawn = Callable[..., Process]


def viewer(spawn: Spawn, endpoint: str, name: str) -> Process:
    started = spawn(str(HERE / "viewer.py"), endpoint, name)
    started.ready()
    return started


def shown(viewers: list[Process], revision: int) -> set[tuple[str, ...]]:
    for each in viewers:
        each.tell(f"show {revision}")
    return {tuple(each.line("has")) for each in viewers}


def test_two_front_ends_and_eight_viewers_end_with_the_same_bits(endpoint: str, spawn: Spawn) -> None:
    viewers = [spawn(str(HERE / "viewer.py"), endpoint, "shared") for _ in range(8)]
    drivers = [spawn(str(HERE / "front_end.py"), endpoint, "shared", letter, "60") for letter in "ab"]
    for each in [*viewers, *drivers]:
        each.ready()
    for driver in drivers:
        driver.tell("go")
    killed, stopped = viewers[:2]
    killed.signal(signal.SIGKILL)
    stopped.signal(signal.SIGSTOP)
    last = max(int(driver.line("done")[0]) for driver in drivers)
    stopped.signal(signal.SIGCONT)
    viewers[0] = viewer(spawn, endpoint, "shared")  # in place of the one that was killed
    (seen,) = shown(viewers, last)
    with bare(endpoint) as service:
        estimate = codec.decode_estimate(service.estimate("shared"))
    assert int(seen[0]) == last == estimate.revision
    assert sum(len(group.keys) for group in estimate.variables) == 120
    assert digest(estimate) == seen[1], "the viewers have what the service has"


def test_a_stopped_viewer_slows_nobody_and_catches_up(endpoint: str, spawn: Spawn) -> None:
    with connect(endpoint, client="robot", timeout_s=60) as bus, bus.map("busy", mirror=False) as driven:
        ring(driven, 1500)
        watching = viewer(spawn, endpoint, "busy")
        watching.signal(signal.SIGSTOP)
        # Enough deltas of the whole map (48 kB each) to fill every buffer on the way to the stopped one.
        # A blocking publication would wait a second for it, five times as long as the patience for all.
        within_patience(lambda: move(driven, int(5 * PATIENCE_S)))
        last = driven.insert(Draft().between_se2("x1", "x3", (2, 0, 0), sigmas=(1, 1, 1)), timeout_s=60).revision
        watching.signal(signal.SIGCONT)
        (seen,) = shown([watching], last)
    assert int(seen[0]) >= last, "it has the last insert, or a further step after it"


def digest(estimate: Estimate) -> str:
    """One hash over keys and values, in the order of the keys, as the viewers make it."""
    keys = np.concatenate([group.keys for group in estimate.variables])
    values = np.concatenate([group.values for group in estimate.variables if group.values is not None])
    order = np.argsort(keys)
    return hashlib.sha256(keys[order].tobytes() + values[order].tobytes()).hexdigest()


def ring(driven: object, poses: int) -> None:
    """A chain of `poses` poses in one insert, slightly off, so that every further edge moves all of them."""
    draft = Draft().se2("x0", (0, 0, 0), fixed=True)
    for n in range(1, poses):
        draft.se2(f"x{n}").between_se2(f"x{n - 1}", f"x{n}", (1, 0, 0.01), sigmas=(0.1, 0.1, 0.02))
    driven.insert(draft, timeout_s=60)  # type: ignore[attr-defined]


def move(driven: object, inserts: int) -> None:
    """Edges that move the whole map, each sent when the one before is answered."""
    for n in range(inserts):
        off = (2, 0.001 * (n % 7 - 3), 0.02)
        draft = Draft().between_se2("x1497", "x1499", off, sigmas=(0.1, 0.1, 0.1)).between_se2(
            "x0", "x1499", (300, 900 + 0.01 * (n % 5), 3), sigmas=(50, 50, 1)
        )  # fmt: skip
        driven.insert(draft, timeout_s=60)  # type: ignore[attr-defined]
