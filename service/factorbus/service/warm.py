"""Compile every kernel of the service ahead of its first use: the solver's, those of features, those of the wire.

A cold start is shared out: one process for each core, and each takes the next kernel that nobody has.  Who has what is
told by files, made by whoever comes first; the kernels themselves meet on disk.  Then this process loads them all.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

from factorbus import solver
from factorbus.idp import kernels as idp_kernels
from factorbus.idp import warm as warm_idp
from factorbus.service import kernels
from factorbus.solver.warm import iter_compile, list_missing

_FEW = 4  # kernels that are worth another process
_MOST = 8  # processes: compiling takes half a gigabyte of memory each


def warm(progress: Callable[[str], None] | None = None) -> float:
    """Compile (or load from disk) all kernels; gives the seconds that took.

    `progress` is called with the name of each kernel that this process compiles, before it does.
    """
    started = time.monotonic()
    if missing := _list_missing():
        _share_out(min(_cores(), _MOST, -(-len(missing) // _FEW)) - 1, progress)
    solver.warm()
    warm_idp()
    solver.warm(None, kernels)
    return time.monotonic() - started


def _share_out(helpers: int, progress: Callable[[str], None] | None) -> None:
    """Compile what is missing together with other processes.  One that fails leaves its kernels to the rest."""
    with tempfile.TemporaryDirectory(prefix="factorbus-warm-") as claims, ExitStack() as stack:
        started = []
        for _ in range(helpers):
            process = subprocess.Popen(
                [sys.executable, "-m", "factorbus.service.warm", claims], stdin=subprocess.DEVNULL
            )
            stack.callback(_end, process)
            started.append(process)
        _take_turns(Path(claims), progress)
        for process in started:
            process.wait()


def _take_turns(claims: Path, progress: Callable[[str], None] | None = None) -> None:
    """Compile one kernel after the other that nobody has claimed."""
    for kernel in _list_missing():
        try:
            (claims / f"{kernel.__module__}.{kernel.__name__}").touch(exist_ok=False)
        except FileExistsError:
            continue
        if progress:
            progress(kernel.__name__)
        for _ in iter_compile(kernel):
            pass


def _list_missing() -> list:
    return list_missing() + list_missing(idp_kernels, kernels)


def _end(process: subprocess.Popen) -> None:
    """At once, if it has not ended: whoever started it is going away."""
    process.kill()
    process.wait()


def _cores() -> int:
    """That this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


if __name__ == "__main__":
    with suppress(FileNotFoundError, KeyboardInterrupt):  # whoever started this has gone
        _take_turns(Path(sys.argv[1]))
