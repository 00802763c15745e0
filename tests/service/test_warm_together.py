"""A cold start shares the kernels out among processes."""

import subprocess
import sys
from pathlib import Path

from factorbus.service import warm as together

_STUBS = """
import sys
from pathlib import Path
from factorbus.service import warm as together

class Kernel:
    def __init__(self, name): self.__name__, self.__module__ = name, "stub"

kernels = [Kernel(f"k{n}") for n in range(200)]
together._list_missing = lambda: [k for k in kernels if not (Path(sys.argv[2]) / k.__name__).exists()]
def compiled(kernel):
    with open(sys.argv[3], "a") as log: log.write(kernel.__name__ + chr(10))
    (Path(sys.argv[2]) / kernel.__name__).touch()
    return ()
together.iter_compile = compiled
together._take_turns(Path(sys.argv[1]))
"""


def test_every_kernel_is_compiled_once_whoever_does_it(tmp_path: Path) -> None:
    claims, done, log = tmp_path / "claims", tmp_path / "done", tmp_path / "log"
    claims.mkdir()
    done.mkdir()
    command = [sys.executable, "-c", _STUBS, str(claims), str(done), str(log)]
    running = [subprocess.Popen(command) for _ in range(3)]
    assert [process.wait(60) for process in running] == [0, 0, 0]
    assert sorted(log.read_text().split()) == sorted(f"k{n}" for n in range(200))


def test_helpers_that_die_leave_their_kernels_to_the_rest(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(together.sys, "executable", "/bin/false")
    told: list[str] = []
    monkeypatch.setattr(together, "_list_missing", list)
    together._share_out(2, told.append)
    assert told == []
