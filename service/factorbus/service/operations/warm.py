"""Compile every kernel of the service ahead of its first use: the solver's, those of features, those of the wire.

A cold start is shared out: one process for each core, and each takes one kernel after the other that nobody has
(`compile_split.py`).  Files, made by the process that comes first, show who has what; the kernels themselves meet on
disk.  Then this process loads them all.

It compiles none itself, and they run none.  Code that has just been compiled and the same from disk are linked in
another order, and may round the last bit otherwise; what comes of a journal after a restart is to be what it was, to
the bit.
"""

import atexit
import gc
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
from factorbus.idp import warm_idp
from factorbus.service import kernels
from factorbus.service.operations.compile_split import CompileSplit, functions_of
from factorbus.service.process.memory import available
from factorbus.service.process.worker_threads import core_count
from factorbus.solver.warm import iter_compile, list_missing, only_compile

_FEW = 4  # kernels that are worth another process
_MOST = 8  # processes: compiling takes half a gigabyte of memory each
_PLENTY = 4 << 30  # for each of them: where nothing of what the compiler drops is looked for, it takes 1.3 gigabytes
# Numba colours the messages of the attempts that it gives up: a twentieth of the time.
_PLAIN_MESSAGES = {"NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING": "1"}
_apart: list[float] = []  # seconds of waiting for them


def warm_service(progress: Callable[[str], None] | None = None) -> float:
    """Compile (or load from disk) all kernels; gives the seconds that took.

    `progress` is called with the name of each kernel that is compiled, before it is.
    """
    started = time.monotonic()
    if missing := missing_kernels():
        share_out(min(core_count(), _MOST, -(-len(missing) // _FEW)), progress)
        _apart.append(time.monotonic() - started)
    solver.warm()
    warm_idp()
    solver.warm(None, kernels)
    return time.monotonic() - started


def seconds_compiling() -> float:
    """Seconds that this process spent compiling kernels, or waiting for those that did it for it."""
    return solver.compile_seconds() + sum(_apart)


def share_out(processes: int, progress: Callable[[str], None] | None) -> None:
    """Compile what is missing in other processes.  One that fails leaves its kernels to the process that needs them."""
    told, tell = os.pipe()
    with tempfile.TemporaryDirectory(prefix="factorbus-warm-") as claims, ExitStack() as stack:
        names = stack.enter_context(os.fdopen(told))
        with os.fdopen(tell, "w") as end:
            for _ in range(processes):
                process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "factorbus.service.operations.warm", claims],
                    stdin=subprocess.DEVNULL,
                    stdout=end,
                    env=os.environ | _PLAIN_MESSAGES,
                )
                stack.callback(_end, process)
        for name in names:  # until the last of them has ended
            if progress:
                progress(name.strip())


def take_turns(claims: Path, progress: Callable[[str], None]) -> None:
    """Compile one kernel after the other that nobody has claimed."""
    collect_garbage_less()
    only_compile()
    kernels = {f"{kernel.__module__}.{kernel.__name__}": kernel for kernel in missing_kernels()}
    for name in CompileSplit(claims, {name: functions_of(kernel) for name, kernel in kernels.items()}):
        progress(kernels[name].__name__)
        for _ in iter_compile(kernels[name]):
            pass


def collect_garbage_less() -> None:
    """To look for what the compiler has dropped takes a tenth of the time; done rarely, half of that.  Where there is
    memory for all of it, it is not done."""
    if available() >= _PLENTY * min(core_count(), _MOST):
        gc.disable()
    else:
        gc.set_threshold(20_000, 20, 1000)


def end_at_once() -> None:
    """End the process as it is.  The interpreter would free all that the compiler has left one by one, and look for
    what refers to itself among a gigabyte of it: a tenth of the time that compiling takes."""
    atexit._run_exitfuncs()
    os._exit(0)


def print_name(name: str) -> None:
    """In one piece, whatever the buffering: others write to the same pipe."""
    os.write(sys.stdout.fileno(), f"{name}\n".encode())


def missing_kernels() -> list:
    return list_missing() + list_missing(idp_kernels, kernels)


def _end(process: subprocess.Popen) -> None:
    """At once, if it has not ended: the process that started it is going away."""
    process.kill()
    process.wait()


if __name__ == "__main__":
    with suppress(FileNotFoundError, BrokenPipeError, KeyboardInterrupt):  # the process that started this has gone
        take_turns(Path(sys.argv[1]), print_name)
        end_at_once()
