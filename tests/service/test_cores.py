"""A service has as many worker threads as it was told to, of the cores that there are."""

import os
import threading
from pathlib import Path

import pytest

from factorbus.service.process import control_groups
from factorbus.service.process import worker_threads as cores
from factorbus.service.process.worker_threads import WorkerThreads
from factorbus.solver.kernels.bayes_tree.step import tree_step
from factorbus.solver.sparse.worker_threads import can_work, count_free
from factorbus.solver.warm import iter_compile

pytestmark = pytest.mark.skipif(
    count_free() == 0, reason="threads cannot sleep in kernels here, so no core can be worker_threads"
)


@pytest.mark.parametrize(
    ("groups", "files", "count"),
    [
        ("0::/a/b\n", {"a/b/cpu.max": "max 100000", "cpu.max": "max 100000"}, 64),
        ("0::/a/b\n", {"a/b/cpu.max": "350000 100000"}, 3),
        ("0::/a/b\n", {"a/b/cpu.max": "350000 100000", "a/cpu.max": "200000 100000"}, 2),
        ("0::/\n", {"cpu.max": "50000 100000"}, 1),
        (
            "3:cpu,cpuacct:/a\n2:memory:/a\n0::/\n",
            {"cpu,cpuacct/a/cpu.cfs_quota_us": "400000", "cpu,cpuacct/a/cpu.cfs_period_us": "100000"},
            4,
        ),
        ("3:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1", "cpu/cpu.cfs_period_us": "100000"}, 64),
        ("", {}, 64),
    ],
)
def test_no_more_cores_than_the_process_has_the_time_of(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, groups: str, files: dict[str, str], count: int
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(64)), raising=False)
    monkeypatch.setattr(control_groups, "GROUPS", tmp_path / "groups")
    monkeypatch.setattr(control_groups, "ROOT", tmp_path)
    (tmp_path / "groups").write_text(groups)
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n")
    assert cores.core_count() == count


def worker_count() -> int:
    return sum(thread.name.startswith("core ") for thread in threading.enumerate())


@pytest.mark.parametrize(("told", "there", "used"), [(2, 4, 2), (4, 2, 2), (2, 1, 1), (1, 4, 1), (99, 99, 8)])
def test_no_more_than_told_and_than_there_are(
    monkeypatch: pytest.MonkeyPatch, told: int, there: int, used: int
) -> None:
    monkeypatch.setattr(cores, "core_count", lambda: there)
    assert list(iter_compile(tree_step))
    free, worker_threads = count_free(), WorkerThreads(told, 0)
    worker_threads.tick(lambda: 0)
    assert worker_threads.counts() == {"used": used, "pieces": 0}
    assert worker_count() == used - 1
    assert count_free() == free - (used - 1)
    worker_threads.close()
    assert worker_count() == 0
    assert count_free() == free


def test_no_thread_compiles_what_nobody_has_asked_for_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "core_count", lambda: 2)
    monkeypatch.setattr(cores, "can_work", lambda: False)
    free, worker_threads = count_free(), WorkerThreads(2, 0)
    worker_threads.tick(lambda: 0)
    assert worker_threads.counts() == {"used": 1, "pieces": 0}
    assert (worker_count(), count_free()) == (0, free)
    assert list(iter_compile(tree_step))
    monkeypatch.setattr(cores, "can_work", can_work)
    for _ in range(2):
        worker_threads.tick(lambda: 0)
        assert worker_threads.counts() == {"used": 2, "pieces": 0}
        assert worker_count() == 1
    worker_threads.close()
    assert (worker_count(), count_free()) == (0, free)


def test_no_core_is_lent_to_small_maps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cores, "core_count", lambda: 2)
    assert list(iter_compile(tree_step))
    worker_threads = WorkerThreads(2, 1000)
    for size, used in ((0, 1), (999, 1), (1000, 2), (0, 2)):
        worker_threads.tick(lambda size=size: size)
        assert worker_threads.counts()["used"] == used
        assert worker_count() == used - 1
    worker_threads.close()
