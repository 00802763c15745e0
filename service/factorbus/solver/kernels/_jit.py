"""How kernels are compiled: the only file that imports numba, and the only one that chooses flags.

`kernel`         compiled on first use, without the interpreter lock, kept on disk.  With signatures it accepts exactly
                 those and never compiles for others:  @kernel("int64(float64[::1], int64[::1])")
`inline_kernel`  melts into the kernels that call it; for what runs in their innermost loops.
`part`           a step of a kernel, called by it and compiled apart: one large function takes far longer to compile.

Numba types a part once in a process; each kernel that calls it, also by way of other parts, links a copy of its own.
A kernel that is called by another is a part there.

The disk cache is a folder named by a hash of every file beside this one, the flags, the versions of Python, numpy,
numba and llvmlite, and the processor.  Numba itself looks only at the file that holds a kernel, so it would run a
stale kernel after a callee in another file was edited.  Hence the rule: a kernel uses nothing from outside this folder
and the files that its `KernelFolder` names.  Kernels of another folder have a `KernelFolder` of their own, and the same
rule for that one.

An index is 0 or more, or a constant that is written where it is used, as in `a[-1]`; ends of slices may be anything.
Python counts other negative ones from the end; a kernel does not look for them, which saves a twentieth of a step.
With every index checked they are errors.

FACTORBUS_CACHE names the folder of these folders (default ~/.cache/factorbus).
NUMBA_DISABLE_JIT=1 leaves the plain Python functions; NUMBA_BOUNDSCHECK=1 checks every index.
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
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding
import numba
import numba.extending
import numpy as np
from llvmlite import ir
from numba.core import caching, cgutils, config, event, types
from numba.core import ir as numba_ir
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.compiler_lock import global_compiler_lock
from numba.core.compiler_machinery import register_pass
from numba.core.lowering import Lower
from numba.core.typed_passes import NativeLowering
from numba.np import arrayobj
from numpy.typing import NDArray

__all__ = [
    "BOUNDSCHECK",
    "DISABLED",
    "F64",
    "I64",
    "KernelFolder",
    "cache_folder",
    "cgutils",
    "compiled_seconds",
    "inline_kernel",
    "intrinsic",
    "ir",
    "is_on_disk",
    "iter_compile",
    "kernel",
    "part",
    "sources_hash",
    "types",
    "vector_lanes",
]

intrinsic: Any = numba.extending.intrinsic

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

DISABLED = bool(getattr(config, "DISABLE_JIT"))  # noqa: B009  (numba sets these when it is imported)
BOUNDSCHECK = bool(getattr(config, "BOUNDSCHECK"))  # noqa: B009

# Sums may be reordered and multiply-adds fused.  Not "nnan" or "ninf": the test of a pivot must see a NaN.
_FASTMATH = {"reassoc", "contract", "arcp", "nsz"}
_EXACT_FLAGS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
_QUICK_FLAGS: dict[str, Any] = {"nogil": False, "error_model": "numpy"}
_FLAGS: dict[str, Any] = {**_EXACT_FLAGS, "fastmath": _FASTMATH}
# Of numba's variables, those that leave the code as it is: no kernel is parallel.
_NO_MATTER = {"NUMBA_NUM_THREADS", "NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING"}
_KEPT_FOLDERS = 6

_from_the_end = arrayobj.fix_integer_index


def _fix_integer_index(context: Any, builder: Any, kind: Any, index: Any, size: Any) -> Any:
    """In our own code only constants count from the end."""
    constant = isinstance(kind, types.IntegerLiteral) or isinstance(index, ir.Constant)
    if constant or not getattr(builder.module, "factorbus", False):
        return _from_the_end(context, builder, kind, index, size)
    return context.cast(builder, index, kind, types.intp)


arrayobj.fix_integer_index = _fix_integer_index


class _OurLower(Lower):
    """The code of our functions: it says that it is, and borrows arrays.

    Arrays that a function is given belong to its caller, who keeps them until it returns: it counts no references.

    Numba counts one more and one less for each row or block of them that is looked at, by atomic operations: up to
    four fifths of the time of short kernels.  A function that gives back an array may give back one that it was given,
    so such a one does count.
    """

    def pre_lower(self) -> None:
        super().pre_lower()
        self.module.factorbus = True

    def lower_assign(self, ty: Any, inst: Any) -> Any:
        given = inst.value
        if not (isinstance(given, numba_ir.Arg) and isinstance(ty, types.Array) and _is_plain(self.fndesc.restype)):
            return super().lower_assign(ty, inst)
        value = self.context.cast(self.builder, self.fnargs[given.index], self.typeof(f"arg.{given.name}"), ty)
        array = self.context.make_array(ty)(self.context, self.builder, value)
        array.meminfo, array.parent = (cgutils.get_null_value(owner.type) for owner in (array.meminfo, array.parent))
        return array._getvalue()


def _is_plain(kind: Any) -> bool:
    """Whether there is no array in it."""
    if isinstance(kind, types.Tuple | types.UniTuple):
        return all(map(_is_plain, kind.types))
    return kind == types.none or isinstance(kind, types.Number | types.Boolean)


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(NativeLowering):
    _name = "borrowing_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return _OurLower


class _PartLibrary(JITCodeLibrary):
    """The code of a part as it was written.  It is linked, optimised and made machine code in the kernels that call it.

    Numba's own libraries do all of that at every level of calls, and wrap each function for Python and for C.
    """

    def add_linking_library(self, library: Any) -> None:
        _add_linked(self._linking_libraries, library)

    def finalize(self) -> None:
        self._finalized = True


class _KernelLibrary(JITCodeLibrary):
    """The code of a kernel and of all parts that it calls, directly or not."""

    def add_linking_library(self, library: Any) -> None:
        library._ensure_finalized()
        _add_linked(self._linking_libraries, library)

    def _optimize_final_module(self) -> None:
        """What the kernel calls is made its own first: nothing of another kernel is taken for it, whatever came before,
        and LLVM passes no argument that nobody reads.  An array is nine words of them, of which two or three are read.
        """
        for function in self._final_module.functions:
            if function.linkage == llvmlite.binding.Linkage.linkonce_odr and not function.is_declaration:
                function.linkage = llvmlite.binding.Linkage.internal
        super()._optimize_final_module()

    def _get_module_for_linking(self) -> Any:
        """What is kept on disk beside the machine code, to be linked by others: nobody does, so only the names."""
        if self._shared_module is None:
            external = llvmlite.binding.Linkage.external
            names = [function.name for function in self.get_defined_functions() if function.linkage == external]
            text = "\n".join(f'define void @"{name}"() {{ ret void }}' for name in names)
            self._shared_module = llvmlite.binding.parse_assembly(text)
        return self._shared_module


def _add_linked(linked: list[Any], library: Any) -> None:
    """`library`, and what it links itself if it is a part's.  Callers stand before what they call: LLVM links only what
    it knows to be called."""
    for one in (library, *library._linking_libraries) if isinstance(library, _PartLibrary) else (library,):
        if one in linked:
            linked.remove(one)
        linked.append(one)


class _Flags(Flags):
    """Numba's flags, compared in a tenth of the time: it looks all functions up by the flags they are called with."""

    __slots__ = ()
    _defaults = Flags().values()
    _hash = hash(Flags())

    def values(self) -> dict[str, Any]:
        return {**self._defaults, **self._values}

    def __hash__(self) -> int:
        return self._hash  # of the names alone, as numba has it


class _Compiler(Compiler):
    """Numba's own compiler, with our lowering."""

    lowering = _Lowering

    def define_pipelines(self) -> list[Any]:
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.passes = [(self.lowering if one is NativeLowering else one, why) for one, why in pipeline.passes]
            pipeline.finalize()
        return pipelines


class _KernelCompiler(_Compiler):
    """The same with our library for a kernel."""

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Flags, names: Any
    ) -> None:
        if library is None:
            library = _KernelLibrary(targetctx.codegen(), "kernel")
            library.enable_object_caching()
        ours: Any = _Flags(flags)
        ours.no_cfunc_wrapper = True  # nobody calls it from C
        super().__init__(typingctx, targetctx, library, args, return_type, ours, names)


@register_pass(mutates_CFG=True, analysis_only=False)
class _PartLowering(_Lowering):
    """Lowering that ends with the code that others link."""

    _name = "part_lowering"

    def run_pass(self, state: Any) -> bool:
        state.flags.no_cpython_wrapper = state.flags.no_cfunc_wrapper = state.flags.no_compile = True
        super().run_pass(state)
        state.library.finalize()
        called_by = object()  # the name by which the code of others calls it
        state.cr = state.cr._replace(cfunc=called_by)
        state.targetctx.insert_user_function(called_by, state.cr.fndesc, [state.library])
        return True


class _PartCompiler(_Compiler):
    lowering = _PartLowering

    def __init__(
        self, typingctx: Any, targetctx: Any, library: Any, args: Any, return_type: Any, flags: Flags, names: Any
    ) -> None:
        library = library or _PartLibrary(targetctx.codegen(), "part")
        super().__init__(typingctx, targetctx, library, args, return_type, _Flags(flags), names)


class KernelFolder:
    """The decorators for the kernels of one folder of sources, and where they are kept.

    family: names the folder of cache folders, of which the last few are kept.  exact: every operation is rounded as it
    is written, none is fused or reordered: the bits depend neither on how a loop is cut up nor on the processor.
    quick: exact, and a call keeps the interpreter lock, because it is done before the lock could be given back.
    also: files outside the folder whose constants or inline kernels its kernels use.
    """

    def __init__(
        self, sources: Path, family: str, exact: bool = False, quick: bool = False, also: tuple[Path, ...] = ()
    ) -> None:
        self._sources, self._family, self._also = sources, family, also
        self._flags = _QUICK_FLAGS if quick else _EXACT_FLAGS if exact else _FLAGS
        self._cache = _cache_in(self)
        self._path: Path | None = None

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

    def path(self) -> Path:
        """The cache folder, made when it is first asked for."""
        if self._path is None:
            self._path = self._make()
        return self._path

    def _compiled(self, function: Callable[..., Any], signatures: tuple[Any, ...]) -> Any:
        if DISABLED:
            return function
        dispatcher = _ours(numba.njit(pipeline_class=_KernelCompiler, **self._flags)(function))
        part = functools.cache(lambda: self._linked(function))  # what other kernels link
        dispatcher.get_call_template = lambda args, kws: part().get_call_template(args, kws)
        dispatcher.get_overload = lambda signature: part().get_overload(signature)
        dispatcher._cache = self._cache(function)
        dispatcher.factorbus_signatures = signatures
        if signatures:
            dispatcher._compile_for_args = _on_first_call(dispatcher)
        return dispatcher

    def _linked(self, function: Callable[..., Any], **flags: Any) -> Any:
        """A function that kernels link.  Called from Python, as tests do, it is compiled as a kernel."""
        dispatcher = _ours(numba.njit(pipeline_class=_PartCompiler, **flags, **self._flags)(function))

        @functools.cache
        def alone() -> Any:
            return _ours(numba.njit(pipeline_class=_KernelCompiler, **self._flags)(function))

        dispatcher.add_overload = lambda result: dispatcher.overloads.update({tuple(result.signature.args): result})
        dispatcher._compile_for_args = lambda *_args, **_kwargs: alone()
        return dispatcher

    def _make(self) -> Path:
        base = Path(os.environ.get("FACTORBUS_CACHE") or Path.home() / ".cache" / "factorbus").expanduser()
        path = base / self._family / sources_hash(self._sources, *self._also)
        try:
            path.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=path).close()
            os.utime(path)
        except OSError as problem:
            return _temporary(path.parent, problem)
        _prune(path.parent, keep=path)
        return path


def compiled_seconds() -> float:
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
    """The folder where kernels of these sources, flags, versions and processor are kept."""
    return _FOLDER.path()


def sources_hash(folder: Path, *also: Path) -> str:
    """The name of the cache folder for kernels whose sources are the Python files in `folder`, this one and `also`."""
    digest = hashlib.sha256()
    for path in sorted({*folder.glob("*.py"), Path(__file__), *also}, key=lambda path: (path.parent.name, path.name)):
        text = path.read_bytes()
        digest.update(f"{path.name} {len(text)}\n".encode() + text)
    features = sorted(name for name, has in llvmlite.binding.get_host_cpu_features().items() if has)
    digest.update(
        repr(
            (
                sys.version,
                platform.machine(),
                (np.__version__, numba.__version__, llvmlite.__version__),
                (llvmlite.binding.get_host_cpu_name(), features),
                sorted((name, value) for name, value in os.environ.items() if _changes_code(name)),
                sorted(_FASTMATH),
            )
        ).encode()
    )
    return digest.hexdigest()[:20]


def _changes_code(variable: str) -> bool:
    return variable.startswith("NUMBA_") and variable not in _NO_MATTER


def _compile_declared(dispatcher: Any) -> None:
    """Compile (or load) the declared signatures once and close the door to others."""
    with global_compiler_lock:
        if dispatcher._can_compile:
            for signature in dispatcher.factorbus_signatures:
                dispatcher.compile(signature)
            dispatcher.disable_compile()
            del dispatcher._compile_for_args


def _on_first_call(dispatcher: Any) -> Callable[..., Any]:
    """Numba calls what this hook returns with the same arguments: the dispatcher, which then knows or refuses them."""

    def compile_for_args(*_args: Any, **_kwargs: Any) -> Any:
        _compile_declared(dispatcher)
        return dispatcher

    return compile_for_args


def _ours(dispatcher: Any) -> Any:
    dispatcher.factorbus = True
    return dispatcher


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
    folders.sort(key=lambda path: path.stat().st_mtime, reverse=True)
    for path in folders[_KEPT_FOLDERS - 1 :]:
        shutil.rmtree(path, ignore_errors=True)


def _cache_in(folder: KernelFolder) -> type[caching.FunctionCache]:
    """Numba's cache of a function, in `folder`.  The folder's name stands for the sources: nothing else is stamped."""

    class Locator(caching._CacheLocator):
        def __init__(self, function: Callable[..., Any]) -> None:
            self._name = f"{function.__module__}.{function.__qualname__}"

        def get_cache_path(self) -> str:
            return str(folder.path())

        def get_source_stamp(self) -> str:
            return self._name

        def get_disambiguator(self) -> str:
            return hashlib.sha256(self._name.encode()).hexdigest()[:8]

        @classmethod
        def from_function(cls, py_func: Callable[..., Any], py_file: str) -> "Locator":
            return cls(py_func)

    class Content(caching.CompileResultCacheImpl):
        _locator_classes = (Locator,)

    class Cache(caching.FunctionCache):
        _impl_class = Content

    return Cache


_COMPILATIONS = _Compilations()
event.register("numba:compile", _COMPILATIONS)

_LENSES = Path(__file__).parent.parent / "lenses"
_FOLDER = KernelFolder(Path(__file__).parent, "kernels", also=tuple(_LENSES.glob("*.py")))
kernel, inline_kernel, part = _FOLDER.kernel, _FOLDER.inline_kernel, _FOLDER.part
