"""A disk that is full, refuses, or is read-only: a clear word, nothing answered is lost, and it goes on by itself.

The disk is a small file system in memory, which takes a mount; where that is not permitted those tests are skipped.  A
file that may not grow (RLIMIT_FSIZE) refuses writes too, with another error, and anybody may set that.
"""

import queue
import resource
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from bare import bare
from journalled import Services, Stream, check_journal, drafts, rows, uninterrupted
from processes import PATIENCE_S
from zenoh.handlers import Callback

from factorbus.client import connect
from factorbus.client.bus import Bus
from factorbus.proto import codec, keys
from factorbus.proto.messages import Batch, Insert
from factorbus.proto.problems import Refused, Unavailable

BEFORE, AFTER = 300, 900
UNLIMITED = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)


class Disk:
    """A file system of a few megabytes."""

    def __init__(self, path: Path, megabytes: int) -> None:
        self.path, self._ballast = path, path / "ballast"
        path.mkdir()
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(path)], capture_output=True, text=True
        )
        if done.returncode:
            pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")

    def fill(self) -> None:
        """Not a byte is left."""
        with self._ballast.open("ab", buffering=0) as file:
            for size in (65536, 512, 1):
                try:
                    while file.write(bytes(size)):
                        pass
                except OSError:
                    continue

    def empty(self) -> None:
        """There is room again."""
        self._ballast.unlink()

    def remount(self, how: str) -> None:
        subprocess.run(["mount", "-o", f"remount,{how}", str(self.path)], check=True)

    def release(self) -> None:
        subprocess.run(["umount", "-l", str(self.path)], check=True)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    # Room for what 1,200 poses take: SQLite's write-ahead log (4 MB), and three checkpoints of 2 MB where two are kept.
    mounted = Disk(tmp_path / "disk", 32)
    yield mounted
    mounted.release()


class Events:
    """What is published on out/event of a map."""

    def __init__(self, endpoint: str, name: str) -> None:
        self._came: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._session = bare(endpoint)
        declare = self._session.__enter__().session.declare_subscriber
        self._subscriber = declare(keys.event_key(name), Callback(self._take, indirect=False))

    def wait_for(self, happened: str) -> None:
        while self._came.get(timeout=PATIENCE_S) != happened:
            pass

    def close(self) -> None:
        self._session.__exit__(None, None, None)

    def _take(self, sample: object) -> None:
        self._came.put(codec.decode_map(sample.payload.to_bytes())["event"])  # type: ignore[attr-defined]


def health(bus: Bus, name: str) -> tuple[bool, bool, str, list[str]]:
    """alive, ready, the journal's problem, and what is missing."""
    stats = next(row for row in bus.stats() if any(each["name"] == name for each in row["maps"]))
    journal = next(each["journal"] for each in stats["maps"] if each["name"] == name)
    assert journal["blocked"] == bool(journal["problem"])
    return stats["alive"], stats["ready"], journal["problem"], stats["missing"]


def check_refused(endpoint: str, name: str) -> None:
    """A stranger is told why, and when to come back."""
    with bare(endpoint) as client:
        answer = client.ask(keys.insert_key(name, "late"), codec.encode_insert(Insert(1, Batch())))
        assert isinstance(answer, Refused)
        assert (answer.code, answer.detail["retry_after_s"] > 0) == ("journal_failed", True)
        assert "Make room" in answer.message


@pytest.mark.parametrize("durability", ["commit", "group", "none"])
@pytest.mark.parametrize("how", ["full", "refuses"])
def test_nothing_is_lost_when_the_disk_takes_nothing_for_a_while(
    services: Callable[..., Services], request: pytest.FixtureRequest, tmp_path: Path, how: str, durability: str
) -> None:
    disk = request.getfixturevalue("disk") if how == "full" else None
    folder = (disk.path if disk else tmp_path) / "journal"
    running = services(folder, f'durability="{durability}"', "checkpoint_s=0.1")
    batches, endpoint = drafts(BEFORE + AFTER), running.start()
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m2", "inc-l") as driven:
        events, stream = Events(endpoint, "m2"), Stream(driven, batches)
        stream.start()
        stream.allow(BEFORE)
        stream.wait_for(BEFORE)
        if disk:
            disk.fill()
        else:
            resource.prlimit(running.pid, resource.RLIMIT_FSIZE, (8192, resource.RLIM_INFINITY))
        stream.allow(AFTER)
        events.wait_for("blocked")
        check_refused(endpoint, "m2")
        alive, ready, problem, missing = running.eventually(lambda: health(bus, "m2"), lambda seen: not seen[1])
        assert (alive, ready) == (True, False)
        assert "cannot be written" in problem
        assert any("map m2 takes nothing" in each for each in missing)
        answered = set(stream.acknowledged)
        there = {int(key) for group in driven.ask_estimate().variables for key in group.keys}
        assert {int(k) for n in answered for g in batches[n - 1].variables for k in g.keys} <= there
        if durability == "commit":
            assert len(there) == driven.stats()["journal"]["inserts"], "what is not written is not there"
        if disk:
            disk.empty()
        else:
            resource.prlimit(running.pid, resource.RLIMIT_FSIZE, UNLIMITED)
        events.wait_for("unblocked")
        stream.wait_for(BEFORE + AFTER)
        assert not stream.fault
        running.eventually(lambda: health(bus, "m2"), lambda seen: seen[1])
        driven.wait_converged(PATIENCE_S)
        estimate = driven.ask_estimate()
        events.close()
    running.end(signal.SIGTERM)
    groups = check_journal(folder / "m2", BEFORE + AFTER)
    assert rows(estimate.variables) == uninterrupted("inc-l", batches, groups)


def test_killed_on_a_full_disk_and_started_on_it(services: Callable[..., Services], disk: Disk) -> None:
    running, batches = services(disk.path / "journal"), drafts(BEFORE + AFTER)
    endpoint = running.start()
    with connect(endpoint, client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m2", "inc-l") as driven:
        stream = Stream(driven, batches)
        stream.start()
        stream.allow(BEFORE)
        stream.wait_for(BEFORE)
        events = Events(endpoint, "m2")
        disk.fill()
        stream.allow(AFTER)
        events.wait_for("blocked")
        events.close()
        running.end(signal.SIGKILL)
        disk.fill()  # whatever that has left free
        running.start()
        assert len(rows(driven.ask_estimate().variables)) == len(stream.acknowledged)
        check_refused(endpoint, "m2")
        assert health(bus, "m2")[:2] == (True, False)
        disk.empty()
        stream.wait_for(BEFORE + AFTER)
        assert not stream.fault
        driven.wait_converged(PATIENCE_S)
        estimate, epoch = driven.ask_estimate(), driven.epoch
        assert driven.stats()["epoch"] == epoch
    running.end(signal.SIGTERM)
    groups = check_journal(disk.path / "journal" / "m2", BEFORE + AFTER)
    assert rows(estimate.variables) == uninterrupted("inc-l", batches, groups)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL], ids=["stopped", "killed"])
@pytest.mark.parametrize("durability", ["commit", "group"])
def test_a_read_only_journal_answers_and_goes_on_when_it_can_be_written(
    services: Callable[..., Services], disk: Disk, number: signal.Signals, durability: str
) -> None:
    running, batches = services(disk.path / "journal", f'durability="{durability}"'), drafts(BEFORE + 50)
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m2", "inc-l") as driven:
        for batch in batches[:BEFORE]:
            driven.send(batch)
        driven.wait_converged(PATIENCE_S)
        last = driven.estimate.revision
        running.eventually(lambda: driven.stats()["journal"]["revision"], lambda written: written == last)
        before = driven.ask_estimate()
        running.end(number)
        disk.remount("ro")
        endpoint = running.start()
        after = driven.ask_estimate()
        assert rows(after.variables) == rows(before.variables)
        same = durability == "commit" or number == signal.SIGTERM
        assert (after.epoch == before.epoch) == same, "a crash begins a new epoch where answers are ahead of the disk"
        check_refused(endpoint, "m2")
        assert health(bus, "m2")[:2] == (True, False)
        assert "readonly" in health(bus, "m2")[2].replace("-", "")
        disk.remount("rw")
        if not same:
            driven.rejoin()
        for batch in batches[BEFORE:]:
            driven.send(batch, timeout_s=PATIENCE_S)
        driven.wait_converged(PATIENCE_S)
        assert driven.ask_estimate().epoch == after.epoch
        assert health(bus, "m2")[:2] == (True, True) or running.eventually(
            lambda: health(bus, "m2"), lambda seen: seen[1]
        )
        estimate = driven.ask_estimate()
    running.end(signal.SIGKILL)
    with connect(running.start(), client="robot", timeout_s=PATIENCE_S) as bus, bus.map("m2", "inc-l") as again:
        if durability == "commit":
            assert rows(again.ask_estimate().variables) == rows(estimate.variables)
        else:
            assert again.epoch != estimate.epoch, "that it was not closed in order was noted when it could be"


def test_a_map_cannot_be_made_on_a_full_disk_and_leaves_nothing(services: Callable[..., Services], disk: Disk) -> None:
    with connect(services(disk.path / "journal").start(), client="robot", timeout_s=PATIENCE_S) as bus:
        disk.fill()
        with pytest.raises(Unavailable, match=r"cannot be written .*full"):
            bus.create("late", timeout_s=1.0)
        assert sorted(path.name for path in (disk.path / "journal").iterdir()) == ["m", "owner.lock"]
        disk.empty()
        assert bus.create("late").revision == 0
