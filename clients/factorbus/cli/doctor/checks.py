"""What the doctor looks at.  A check looks, never changes anything, and gives one finding."""

import ctypes
import os
import platform
import resource
import shutil
import socket
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from factorbus.cli.output.exits import EXTRAS, Stopped, missing_modules
from factorbus.cli.output.installing import install_command
from factorbus.cli.output.versions import LIBRARIES, installed
from factorbus.cli.process.options import USUAL_ENDPOINT
from factorbus.ownership import UnsafeFolder, check_folder, make_private
from factorbus.proto.problems import Problem
from factorbus.proto.version import __version__
from factorbus.wording import counted


@dataclass(frozen=True, slots=True)
class Finding:
    """state: "ok", "warn" (works, could be better) or "fail".  mend: the next move, where there is one."""

    name: str
    state: str
    seen: str
    mend: str = ""


def python() -> Finding:
    """the interpreter"""
    return Finding("python", "ok", f"{platform.python_version()} at {sys.executable}, {platform.platform()}")


def libraries() -> Finding:
    """the libraries"""
    have = {name: installed(name) for name in LIBRARIES}
    seen = ", ".join([f"factorbus {__version__}", *(f"{name} {version}" for name, version in have.items() if version)])
    if missing_modules("service"):
        mend = f"fine for a front end; for solver and workers: {install_command('service')}"
        return Finding("libraries", "warn", f"{seen}; a light client without the solver", mend)
    if missing_modules("viz"):
        return Finding("libraries", "warn", f"{seen}; no pictures", install_command("viz"))
    return Finding("libraries", "ok", seen)


def cholmod() -> Finding:
    """SuiteSparse's CHOLMOD and its BLAS"""
    if find_spec("sksparse") is None:
        seen = 'CHOLMOD is not installed (scikit-sparse): all but backend="cholmod" works without it'
        mend = f"if wanted: apt-get install libsuitesparse-dev build-essential, then {install_command('cholmod')}"
        return Finding("cholmod", "ok", seen, mend)
    try:
        import sksparse.cholmod  # noqa: F401
    except ImportError as error:
        mend = "pip install --force-reinstall --no-deps --no-binary scikit-sparse scikit-sparse==0.4.16"
        return Finding("cholmod", "fail", f"scikit-sparse does not load: {error}", mend)
    mapped = _mapped_libraries()
    library = next((path for path in mapped if "libcholmod" in path), None)
    blas = [path for path in mapped if "blas" in Path(path).name]
    seen = f"CHOLMOD {_cholmod_version(library)}, BLAS {', '.join(blas) or 'unknown'}"
    if blas and not any(name in " ".join(blas) for name in ("openblas", "mkl", "blis", "atlas", "Accelerate")):
        mend = "the reference BLAS makes CHOLMOD several times slower: apt-get install libopenblas0-pthread"
        return Finding("cholmod", "warn", seen, mend)
    return Finding("cholmod", "ok", seen)


def numba() -> Finding:
    """Numba"""
    if missing_modules("service"):
        return Finding(
            "numba", "warn", "not looked at: solver and workers are not installed", install_command("service")
        )
    try:
        from factorbus.solver import why_stock_numba
    except ValueError as wrong:
        return Finding("numba", "fail", str(wrong), "unset FACTORBUS_STOCK_NUMBA")
    except UnsafeFolder:
        seen = f"numba {installed('numba')}; not looked at: no kernel loads while their cache is not safe"
        return Finding("numba", "warn", seen, "see kernel cache")
    seen = f"numba {installed('numba')}"
    if why := why_stock_numba():
        mend = "unset FACTORBUS_STOCK_NUMBA" if "FACTORBUS_STOCK_NUMBA" in why else "pip install one of those tested"
        return Finding("numba", "warn", f"{seen}, as it is: {why}; kernels compile and run slower", mend)
    return Finding("numba", "ok", f"{seen}, which kernels have been tested with")


def cache() -> Finding:
    """the cache of compiled kernels"""
    folder = Path(os.environ.get("FACTORBUS_CACHE") or Path.home() / ".cache" / "factorbus").expanduser()
    try:
        # What is made in it is looked at, as by those who load it: a volume of a container may itself be everybody's.
        make_private("the cache of compiled kernels", folder / "kernels")
        for inside in (path for path in folder.glob("*/*") if path.is_dir()):
            check_folder("the cache of compiled kernels", inside)
        tempfile.TemporaryFile(dir=folder / "kernels").close()
    except UnsafeFolder as unsafe:
        return Finding("kernel cache", "fail", unsafe.message, "compiled kernels are code: who can write there runs it")
    except OSError as error:
        mend = "make it writable, or set FACTORBUS_CACHE to a folder that is; until then every start compiles"
        return Finding("kernel cache", "fail", f"{folder}: {error.strerror}", mend)
    free = shutil.disk_usage(folder).free
    if free < 200 << 20:
        return Finding("kernel cache", "warn", f"{folder}: {free >> 20} MiB free", "kernels take some 50 MiB")
    compiled = sum(1 for _ in folder.glob("kernels/*/*.nbc"))
    if not compiled:
        return Finding("kernel cache", "warn", f"{folder}: empty", "factorbus warm compiles ahead")
    return Finding("kernel cache", "ok", f"{folder}: {counted(compiled, 'compiled kernel')}, {free >> 30} GiB free")


def port() -> Finding:
    """the usual port"""
    number = int(USUAL_ENDPOINT.rpartition(":")[2])
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", number))
            return Finding("port", "ok", f"{number} is free for factorbus serve")
        except OSError:
            pass
    from factorbus.client import connect

    try:
        with connect(USUAL_ENDPOINT, client="doctor", timeout_s=3) as bus:
            return Finding(
                "port", "ok", f"{number} is taken by a factorbus service with {counted(len(bus.maps()), 'map')}"
            )
    except Problem:
        mend = f"stop what listens there (ss -ltnp 'sport = :{number}'), or factorbus serve --listen tcp/127.0.0.1:7448"
        return Finding("port", "warn", f"{number} is taken by something that is no factorbus service", mend)


def bus() -> Finding:
    """a round trip over the bus"""
    if missing_modules("service"):
        return Finding("bus", "warn", "not tried: it needs a solver process", install_command("service"))
    from factorbus.cli.process.children import service
    from factorbus.client import connect

    times = []
    try:
        with service("--no-warm", timeout_s=60) as (_, endpoint), connect(endpoint, client="doctor") as line:
            for _ in range(50):
                start = time.perf_counter()
                line.maps()
                times.append((time.perf_counter() - start) * 1e3)
    except (Stopped, Problem) as problem:
        return Finding("bus", "fail", problem.message, "try factorbus serve by hand: it says what is wrong")
    seen = f"a solver process answers on loopback in {statistics.median(times):.2f} ms (p50 of {len(times)})"
    return Finding("bus", "ok", seen)


def shared_memory() -> Finding:
    """/dev/shm"""
    folder = Path("/dev/shm")
    if not folder.is_dir():
        return Finding("shared memory", "ok", "there is no /dev/shm; the bus does not need it")
    free = shutil.disk_usage(folder).free
    seen = f"{folder}: {free >> 20} MiB free; the bus uses it only where a Zenoh configuration says so"
    if free < 64 << 20:
        return Finding("shared memory", "warn", seen, "before turning it on: docker run --shm-size=256m, or --ipc=host")
    return Finding("shared memory", "ok", seen)


def clock() -> Finding:
    """the clock"""
    name = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    source = name.read_text().strip() if name.is_file() else "unknown"
    reads = 10_000
    start = time.perf_counter()
    for _ in range(reads):
        time.perf_counter()
    cost_ns = (time.perf_counter() - start) / reads * 1e9
    seen = f"{source}, {cost_ns:.0f} ns a reading"
    if cost_ns > 1000:
        return Finding("clock", "warn", seen, "a slow clock blurs step times; the usual cure is clocksource=tsc")
    return Finding("clock", "ok", seen)


def machine_limits() -> Finding:
    """cores and limits"""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    load = os.getloadavg()[0]
    seen = f"{counted(cores, 'core')}, load {load:.1f}, {counted(files, 'open file')} allowed"
    if cores < 2:
        return Finding("machine", "warn", seen, "one core is shared by solver and bus: expect jitter")
    if files < 1024:
        return Finding("machine", "warn", seen, "ulimit -n 4096 for a service with many clients")
    if load > cores:
        return Finding("machine", "warn", seen, "other processes take the cores: times are worse than they could be")
    return Finding("machine", "ok", seen)


def wall_clock() -> Finding:
    """whether the wall clock is kept right"""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "adjtimex"):
        return Finding("wall clock", "ok", "not looked at: this system does not say how it is kept")
    state = libc.adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))  # modes 0: only asks
    if state == _UNSYNCHRONIZED:
        mend = "stamps of several machines will not line up: start chrony, or systemd-timesyncd"
        return Finding("wall clock", "warn", "nobody keeps it right (no NTP)", mend)
    if state < 0:
        return Finding("wall clock", "ok", "not looked at: not allowed here")
    return Finding("wall clock", "ok", "kept right by NTP or the host")


def extras() -> Finding:
    """the extras"""
    have = [name for name in EXTRAS if not missing_modules(name)]
    missing = [name for name in EXTRAS if name not in have]
    seen = f"{', '.join(have) or 'none'} installed" + (f"; without {', '.join(missing)}" if missing else "")
    mend = f"if wanted: {install_command(*missing)}" if missing else ""
    return Finding("extras", "ok", seen, mend)


def permissions() -> Finding:
    """what this user may do"""
    for what, folder in (("the temporary folder", Path(tempfile.gettempdir())), ("this folder", Path.cwd())):
        if not os.access(folder, os.W_OK | os.X_OK):
            mend = (
                "set TMPDIR to one that is" if what != "this folder" else "pictures and recordings need --out elsewhere"
            )
            return Finding("permissions", "warn", f"{what}, {folder}, is not writable", mend)
    if Path("/proc/self").is_dir() and not os.access("/proc/self/fd", os.R_OK | os.X_OK):
        mend = "features go over the bus instead of through memory; mount /proc without hidepid for this user"
        return Finding("permissions", "warn", "/proc/self/fd cannot be read", mend)
    user = os.getuid() if hasattr(os, "getuid") else "?"
    return Finding("permissions", "ok", f"user {user} may write to {tempfile.gettempdir()} and {Path.cwd()}")


# Larger than `struct timex` on every Linux; its first field, modes, is zero.
_TIMEX_BYTES, _UNSYNCHRONIZED = 512, 5

CHECKS: tuple[Callable[[], Finding], ...] = (
    python, libraries, extras, cholmod, numba, cache, machine_limits, clock, wall_clock, shared_memory, permissions,
    port, bus,
)  # fmt: skip


def _mapped_libraries() -> list[str]:
    """The system's shared libraries in this process: not the BLAS that numpy and scipy bring along."""
    maps = Path("/proc/self/maps")
    if not maps.is_file():
        return []
    paths = {line.split(maxsplit=5)[5] for line in maps.read_text().splitlines() if line.count("/") > 0}
    return sorted(path for path in paths if ".so" in path and "site-packages" not in path)


def _cholmod_version(library: str | None) -> str:
    if library is None:
        return "of unknown version"
    parts = (ctypes.c_int * 3)()
    try:
        ctypes.CDLL(library).cholmod_version(parts)
    except (OSError, AttributeError):
        return library
    return ".".join(map(str, parts))
