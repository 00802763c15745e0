"""How kernels are compiled and kept: flags are chosen here.  What is changed inside Numba is in `lowering`.

`kernel`         compiled on first use, without the interpreter lock, kept on disk.  With signatures it accepts exactly
                 those and never compiles for others:  @kernel("int64(float64[::1], int64[::1])")
`inline_kernel`  melts into the kernels that call it; for what runs in their innermost loops.
`part`           a step of a kernel, called by it and compiled apart: one large function takes far longer to compile.
`shared_kernel`  a part that kernels call by its address and do not link: for a large one that many of them call.

Numba types a part once in a process; each kernel that calls it, also by way of other parts, links a copy of its own.
A kernel that is called by another is a part there.

The disk cache is a folder named by a hash of every file beside this one, the flags, the versions of Python, numpy,
numba and llvmlite, and the processor.  In it a kernel is a file named by all that was compiled into it (`stamps`).
Numba itself looks only at the file that holds a kernel, so it would run a stale kernel after a callee in another file
was edited.  How a function is compiled says the `KernelFolder` that decorates it.

No slice or row is assigned an array, which is refused, and none is sorted by NumPy's way: to compile what the one says
of unlike sizes, and the other, takes three seconds in each process.

An index is 0 or more, or a constant that is written where it is used, as in `a[-1]` and `a[-1, k]`, but not in
`a[-1, 1:]`, which is refused; ends of slices may be anything.
Python counts other negative ones from the end; a kernel does not look for them, which saves a twentieth of a step.
With every index checked they are errors.

FACTORBUS_CACHE names the folder of these folders (default ~/.cache/factorbus).  What is in them is run as code, so it
is used only if nobody but this user and root can write there, to a folder or a file; what is made is for them alone.
NUMBA_DISABLE_JIT=1 leaves the plain Python functions; NUMBA_BOUNDSCHECK=1 checks every index.  FACTORBUS_STOCK_NUMBA=1,
or a release of Numba that was not tested (`releases`), leaves Numba as it is: each kernel and part is compiled by its
own compiler, with its rules for references and indices.
"""

import atexit
import functools
import hashlib
import os
import platform
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numba.extending
import numpy as np
from llvmlite import ir
from numba.core import cgutils, config, event, types
from numba.core.compiler_lock import global_compiler_lock
from numba.core.typing.templates import AttributeTemplate
from numpy.typing import NDArray

from factorbus.ownership import make_private

# From beside this file: a copy of them elsewhere is one by itself.
from . import releases
from .disk import cache_in, used_at
from .frame_room import call_with_room
from .shared import SharedKernel, only_compile
from .stamps import stamp_of

__all__ = [
    "BOUNDSCHECK",
    "DISABLED",
    "F64",
    "I64",
    "AttributeTemplate",
    "KernelFolder",
    "cache_folder",
    "cgutils",
    "code_environment",
    "compile_seconds",
    "compilers_hash",
    "extending",
    "inline_kernel",
    "intrinsic",
    "ir",
    "is_on_disk",
    "iter_compile",
    "kernel",
    "only_compile",
    "part",
    "shared_kernel",
    "types",
    "vector_lanes",
]

extending: Any = numba.extending
intrinsic: Any = numba.extending.intrinsic

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DISABLED = bool(getattr(config, "DISABLE_JIT"))  # noqa: B009  (numba sets these when it is imported)
STOCK = bool(releases.why_stock())
BOUNDSCHECK = bool(getattr(config, "BOUNDSCHECK"))  # noqa: B009

# Not even imported where Numba is used as it is: another release may not have the names.
_lowering: Any = None if STOCK else import_module(".lowering", __package__)

# Sums may be reordered and multiply-adds fused.  Not "nnan" or "ninf": the test of a pivot must see a NaN.
_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}
# A flag that is left out is taken over from the function that has this one compiled first: a part that an inline kernel
# calls would be inlined wherever it is called, or nowhere, by the order in which kernels are compiled.
_EXACT_FLAGS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False, "forceinline": False}
_QUICK_FLAGS: dict[str, Any] = {**_EXACT_FLAGS, "nogil": False}
_FLAGS: dict[str, Any] = {**_EXACT_FLAGS, "fastmath": _FASTMATH}
# Of numba's variables, those that leave the code as it is: no kernel is parallel.
_NO_MATTER = {"NUMBA_NUM_THREADS", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"}
_KEPT_FOLDERS = 6


class KernelFolder:
    """The decorators for the kernels of one folder of sources, and where they are kept.

    family: names the folder of cache folders, of which the last few are kept.  exact: every operation is rounded as it
    is written, none is fused or reordered: the bits depend neither on how a loop is cut up nor on the processor.
    quick: exact, and a call keeps the interpreter lock, because it is done before the lock could be released.
    """

    def __init__(self, family: str, exact: bool = False, quick: bool = False) -> None:
        self._family = family
        self._flags = _QUICK_FLAGS if quick else _EXACT_FLAGS if exact else _FLAGS
        self._cache = cache_in(self.path)
        self._path: Path | None = None
        self._shared: list[SharedKernel] = []

    def kernel(self, *signatures: Any) -> Any:
        """`@kernel` or `@kernel("int64(float64[::1])", ...)`: see the head of this file."""
        if len(signatures) == 1 and callable(signatures[0]):
            return self._compiled(signatures[0], ())
        return lambda function: self._compiled(function, signatures)

    def inline_kernel(self, function: Callable[..., Any]) -> Any:
        """A small function that is always inlined into the kernels that call it, so it needs no cache of its own."""
        if DISABLED:
            return function
        return self._linked(function, forceinline=True)

    def part(self, function: Callable[..., Any]) -> Any:
        """A step of a kernel, kept on disk with the kernel that calls it."""
        if DISABLED:
            return function
        return self._linked(function)

    def shared_kernel(self, signature: Any) -> Any:
        """`@shared_kernel(types.float64(types.int64))`: compiled once; kernels of this folder call it by its address.

        As `kernel` where nothing is called so.
        """

        def made(function: Callable[..., Any]) -> Any:
            dispatcher = self._compiled(function, (signature,))
            if not (DISABLED or STOCK):
                name = functools.cache(lambda: f"{self._family} {self.path().name} {function.__qualname__}")
                self._shared.append(SharedKernel(dispatcher, signature, name, _compile_declared))
            return dispatcher

        return made

    def path(self) -> Path:
        """The cache folder, made when it is first asked for.  Raises UnsafeFolder: others can write to it."""
        if self._path is None:
            self._path = self._make()
        return self._path

    def _compiled(self, function: Callable[..., Any], signatures: tuple[Any, ...]) -> Any:
        if DISABLED:
            return function
        dispatcher = self._alone(function)
        if not STOCK:
            part = functools.cache(lambda: self._linked(function))  # what other kernels link
            dispatcher.get_call_template = lambda args, kws: part().get_call_template(args, kws)
            dispatcher.get_overload = lambda signature: part().get_overload(signature)
        dispatcher._cache = self._cache(function, lambda: stamp_of(dispatcher))
        dispatcher.factorbus_signatures = signatures
        if signatures:
            dispatcher._compile_for_args = _on_first_call(dispatcher)
        return dispatcher

    def _linked(self, function: Callable[..., Any], **flags: Any) -> Any:
        """A function that kernels link.  Called from Python, as tests do, it is compiled as a kernel."""
        if STOCK:
            return self._ours(numba.njit(**{**self._flags, **flags})(function))
        flags = {"pipeline_class": _lowering.PartCompiler, **self._flags, **flags}
        dispatcher = self._ours(numba.njit(**flags)(function))
        find = dispatcher.get_call_template
        dispatcher.get_call_template = lambda args, kws: find(tuple(map(_common, args)), kws)

        alone = functools.cache(lambda: self._alone(function))
        dispatcher.add_overload = lambda result: dispatcher.overloads.update({tuple(result.signature.args): result})
        dispatcher._compile_for_args = lambda *_args, **_kwargs: alone()
        return dispatcher

    def _alone(self, function: Callable[..., Any]) -> Any:
        """A function that Python calls."""
        compiler = {} if STOCK else {"pipeline_class": _lowering.KernelCompiler}
        return self._ours(numba.njit(**compiler, **self._flags)(function))

    def _ours(self, dispatcher: Any) -> Any:
        dispatcher.factorbus = True
        compile_ = dispatcher.compile

        def compile_changed(signature: Any) -> Any:
            with global_compiler_lock:
                self._provide_shared()
                with _lowering.changed_numba():
                    return compile_(signature)

        if not STOCK:
            dispatcher.compile = compile_changed
        return dispatcher

    def _provide_shared(self) -> None:
        """All that code may call, also code from disk: what a shared kernel calls is declared before it."""
        for shared in self._shared:
            if shared.is_being_made:
                return
            shared.provide()

    def _make(self) -> Path:
        base = Path(os.environ.get("FACTORBUS_CACHE") or Path.home() / ".cache" / "factorbus").expanduser()
        path = base / self._family / compilers_hash()
        try:
            make_private("the cache of compiled kernels", path)
            tempfile.TemporaryFile(dir=path).close()
            os.utime(path)
        except OSError as problem:
            return _temporary(path.parent, problem)
        _prune(path.parent, keep=path)
        return path


def compile_seconds() -> float:
    """Seconds spent compiling kernels in this process; 0.0 when all came from disk."""
    return _COMPILATIONS.duration if _COMPILATIONS.done else 0.0


def iter_compile(*kernels: Any) -> Iterator[str]:
    """Compile (or load) kernels that have signatures, one per turn; gives the name of the one that comes next."""
    for function in kernels:
        yield function.__name__
        if not DISABLED:
            _compile_declared(function)


def is_on_disk(function: Any) -> bool:
    """Whether a kernel with signatures has been compiled before, as these sources have it."""
    return DISABLED or Path(function._cache._cache_file._index_path).is_file()


def vector_lanes() -> int:
    """Doubles in the widest vector register of this processor."""
    features = llvmlite.binding.get_host_cpu_features()
    if features.get("avx512f"):
        return 8
    return 4 if features.get("avx") else 2


def cache_folder() -> Path:
    """The folder where the solver's kernels for these flags, versions and processor are kept."""
    return _FOLDER.path()


@functools.cache
def compilers_hash() -> str:
    """The name of a cache folder: how kernels are compiled, the files beside this one, and for what."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        text = path.read_bytes()
        digest.update(f"{path.name} {len(text)}\n".encode() + text)
    digest.update(repr((sys.version, sorted(code_environment().items()), sorted(_FASTMATH), STOCK)).encode())
    return digest.hexdigest()[:20]


def code_environment() -> dict[str, str]:
    """What compiled code depends on besides its sources: the processor with a hash of its features, versions, flags."""
    features = sorted(name for name, has in llvmlite.binding.get_host_cpu_features().items() if has)
    can = hashlib.sha256(" ".join(features).encode()).hexdigest()[:8]
    libraries = f"numpy {np.__version__}, numba {numba.__version__}, llvmlite {llvmlite.__version__}"
    return {
        "processor": f"{platform.machine()} {llvmlite.binding.get_host_cpu_name()} {can}",
        "versions": f"Python {sys.version.split()[0]}, {libraries}",
        "flags": " ".join(sorted(f"{name}={value}" for name, value in os.environ.items() if _changes_code(name))),
    }


def _changes_code(variable: str) -> bool:
    return variable.startswith("NUMBA_") and variable not in _NO_MATTER


def _compile_declared(dispatcher: Any) -> None:
    """Compile (or load) the declared signatures once and close the door to others."""
    with global_compiler_lock:
        if dispatcher._can_compile:
            for signature in dispatcher.factorbus_signatures:
                call_with_room(dispatcher.compile, signature)
            dispatcher.disable_compile()
            del dispatcher._compile_for_args


def _on_first_call(dispatcher: Any) -> Callable[..., Any]:
    """Numba calls what this hook returns with the same arguments: the dispatcher, which then knows or refuses them."""

    def compile_for_args(*_args: Any, **_kwargs: Any) -> Any:
        _compile_declared(dispatcher)
        return dispatcher

    return compile_for_args


def _common(kind: Any) -> Any:
    """The kind of an argument.  Constants are kinds of their own, and a part is compiled apart for each: for sizes.  A
    zero is no size but the place where something begins, and what is true or false decides nothing inside a loop."""
    is_zero = isinstance(kind, types.IntegerLiteral) and kind.literal_value == 0
    return types.intp if is_zero else types.boolean if isinstance(kind, types.BooleanLiteral) else kind


class _Compilations(event.TimingListener):
    """Adds up the time of the outermost compilations of our kernels; the compiler lock makes them sequential."""

    def notify(self, event: Any) -> None:
        if getattr(event.data["dispatcher"], "factorbus", False):
            super().notify(event)


def _temporary(base: Path, problem: OSError) -> Path:
    path = Path(tempfile.mkdtemp(prefix="factorbus-kernels-"))
    atexit.register(shutil.rmtree, path, ignore_errors=True)
    warnings.warn(
        f"compiled kernels cannot be kept in {base} ({problem.strerror}): they go to {path} and are compiled again at "
        "the next start; make the folder writable or set FACTORBUS_CACHE to one that is",
        RuntimeWarning,
        stacklevel=2,
    )
    return path


def _prune(base: Path, keep: Path) -> None:
    """Remove all but the folders used last.  A process that still runs from one of them has its code in memory."""
    folders = [path for path in base.iterdir() if path.is_dir() and path != keep]
    folders.sort(key=used_at, reverse=True)
    for path in folders[_KEPT_FOLDERS - 1 :]:
        shutil.rmtree(path, ignore_errors=True)


_COMPILATIONS = _Compilations()
event.register("numba:compile", _COMPILATIONS)

_FOLDER = KernelFolder("kernels")
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
shared_kernel = _FOLDER.shared_kernel
