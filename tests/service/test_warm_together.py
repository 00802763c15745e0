"""A cold start shares the kernels out among processes."""

import gc
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from factorbus.service.operations import warm as together

_STUBS = """
import sys
from pathlib import Path
from factorbus.service.operations import warm as together

class Kernel:
    def __init__(self, name): self.__name__, self.__module__, self.py_func = name, "stub", lambda: None

kernels = [Kernel(f"k{n}") for n in range(200)]
together.missing_kernels = lambda: [k for k in kernels if not (Path(sys.argv[2]) / k.__name__).exists()]
def compiled(kernel):
    with open(sys.argv[3], "a") as log: log.write(kernel.__name__ + chr(10))
    (Path(sys.argv[2]) / kernel.__name__).touch()
    return ()
together.iter_compile = compiled
together.take_turns(Path(sys.argv[1]), print)
"""


def test_every_kernel_is_compiled_once_by_any_process(tmp_path: Path) -> None:
    claims, done, log = tmp_path / "claims", tmp_path / "done", tmp_path / "log"
    claims.mkdir()
    done.mkdir()
    command = [sys.executable, "-c", _STUBS, str(claims), str(done), str(log)]
    running = [subprocess.Popen(command) for _ in range(3)]
    assert [process.wait(60) for process in running] == [0, 0, 0]
    assert sorted(log.read_text().split()) == sorted(f"k{n}" for n in range(200))


def test_those_that_die_leave_their_kernels_to_the_process_that_needs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(together.sys, "executable", "/bin/false")
    told: list[str] = []
    together.share_out(2, told.append)
    assert told == []


def test_a_cold_start_compiles_in_other_processes_and_says_what(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is loaded is the same, to the bit, as what a later start loads."""
    missing = [type("Kernel", (), {"__name__": f"k{n}"}) for n in range(9)]
    monkeypatch.setattr(together, "missing_kernels", lambda: missing)
    monkeypatch.setattr(together, "iter_compile", pytest.fail)
    monkeypatch.setenv("PYTHONUNBUFFERED", "1")
    asked: list[list[str]] = []
    popen = subprocess.Popen

    def compiling(command: list[str], **how: Any) -> subprocess.Popen:
        asked.append(command)
        telling = f"for n in range(20_000): warm.print_name('kernel {len(asked)} ' + str(n))"
        return popen([sys.executable, "-c", f"from factorbus.service.operations import warm\n{telling}"], **how)

    monkeypatch.setattr(together.subprocess, "Popen", compiling)
    monkeypatch.setattr(together, "core_count", lambda: 2)
    before, told = together.seconds_compiling(), []
    together.warm_service(told.append)
    assert sorted(told) == sorted(f"kernel {process} {n}" for process in (1, 2) for n in range(20_000))
    assert {tuple(command[:4]) for command in asked} == {
        (sys.executable, "-P", "-m", "factorbus.service.operations.warm")
    }
    assert together.seconds_compiling() > before, "who waits for them says so"


@pytest.mark.parametrize(("gigabytes", "collects"), [(7, True), (8, False)])
def test_memory_is_spent_to_save_time_where_each_process_has_plenty(
    monkeypatch: pytest.MonkeyPatch, gigabytes: int, collects: bool
) -> None:
    monkeypatch.setattr(together, "core_count", lambda: 2)
    monkeypatch.setattr(together, "available", lambda: gigabytes << 30)
    before = gc.get_threshold()
    try:
        together.collect_garbage_less()
        assert gc.isenabled() == collects
        assert (gc.get_threshold() > before) == collects
    finally:
        gc.enable()
        gc.set_threshold(*before)
