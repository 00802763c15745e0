"""A service has as many threads that lend their cores as it was told to, of the cores that there are."""

import os
import threading
from pathlib import Path

import pytest

from factorbus.service import control_groups, cores
from factorbus.service.cores import LentCores
from factorbus.solver.lending import count_free

pytestmark = pytest.mark.skipif(
    count_free() == 0, reason="threads cannot sleep in kernels here, so no core can be lent"
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


def lending() -> int:
    return sum(thread.name.startswith("core ") for thread in threading.enumerate())


@pytest.mark.parametrize(("told", "there", "used"), [(2, 4, 2), (4, 2, 2), (2, 1, 1), (1, 4, 1), (99, 99, 8)])
def test_no_more_than_told_and_than_there_are(
    monkeypatch: pytest.MonkeyPatch, told: int, there: int, used: int
) -> None:
    monkeypatch.setattr(cores, "core_count", lambda: there)
    free, lent = count_free(), LentCores(told)
    assert lent.account() == {"used": used, "pieces": 0}
    assert lending() == used - 1
    assert count_free() == free - (used - 1)
    lent.close()
    assert lending() == 0
    assert count_free() == free
