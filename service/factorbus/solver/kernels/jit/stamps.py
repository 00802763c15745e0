"""What a compiled kernel was made of: a hash of the functions that are in it and of the constants that these use.

A kernel on disk has its stamp in its name, so that an edit compiles the kernels anew that have the function in them,
and no other.  A comment, a docstring or a line more above is no edit.  How kernels are compiled, the files beside this
one, and what they are compiled for, is in the name of the folder (`compile`).

Of a function count its bytecode, its constants, how it is compiled, and all that it names: numbers, tuples and arrays
by their values, records by their fields, parts and inline kernels as itself.  A kernel that is called by its address is
not in its caller, which has its signature.  Of what is no kernel, as an intrinsic, the whole file counts.  A function
of others, as of NumPy, goes by its name: its version is in the folder's.
"""

import hashlib
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any, get_type_hints

import numpy as np

__all__ = ["stamp_of"]

_PLAIN = (type(None), bool, int, float, complex, str, bytes)


def stamp_of(kernel: Any) -> str:
    """Of a kernel and all that is compiled into it.  Raises TypeError: it names something that has no stamp."""
    found: dict[Any, str] = {}
    open_ = [kernel]
    while open_:
        one = open_.pop()
        if one.py_func not in found:
            found[one.py_func], called = _look_at(one)
            open_ += called
    return _hash(*_declared(kernel), *sorted(found.values()))[:20]


def _declared(kernel: Any) -> tuple[str, ...]:
    return kernel.py_func.__qualname__, *map(str, getattr(kernel, "factorbus_signatures", ()))


@cache
def _look_at(kernel: Any) -> tuple[str, list[Any]]:
    """Of a function itself; the kernels and parts that it names."""
    function, called = kernel.py_func, []
    names = {name for code in _codes(function.__code__) for name in code.co_names}
    parts = [function.__module__, function.__qualname__, _of_value("options", kernel.targetoptions, names, called)]
    parts += [_of_code(code, function.__doc__) for code in _codes(function.__code__)]
    closed = [cell.cell_contents for cell in function.__closure__ or ()]
    used = {name: function.__globals__[name] for name in sorted(names & function.__globals__.keys())}
    for name, value in {"closure": closed, "defaults": function.__defaults__, **used}.items():
        parts += [name, _of_value(f"{function.__module__}.{function.__qualname__}: {name}", value, names, called)]
    return _hash(*parts), called


def _codes(code: CodeType) -> Iterator[CodeType]:
    """It, and what is defined inside."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _of_code(code: CodeType, documented: str | None) -> str:
    constants = [
        _of_value(code.co_name, one, set(), [])
        for one in code.co_consts
        if not isinstance(one, CodeType) and (documented is None or one != documented)
    ]
    counts = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    variables = code.co_names, code.co_varnames, code.co_cellvars, code.co_freevars
    return _hash(code.co_name, code.co_code.hex(), code.co_exceptiontable.hex(), repr(counts + variables), *constants)


def _of_value(where: str, value: Any, names: set[str], called: list[Any]) -> str:
    """The hash of what a function names; kernels and parts are put into `called`."""
    kind = f"{type(value).__module__}.{type(value).__qualname__}"
    if hasattr(value, "py_func"):
        if getattr(value, "factorbus_shared", False):
            return _hash("shared", *_declared(value))
        called.append(value)
        return "kernel"
    if type(value) in _PLAIN or isinstance(value, np.generic | np.dtype):
        return _hash(kind, repr(value))
    if isinstance(value, np.ndarray):
        return _hash(kind, value.dtype.str, repr(value.shape), np.ascontiguousarray(value).tobytes().hex())
    if isinstance(value, tuple | list):
        return _hash(kind, *(_of_value(where, one, names, called) for one in value))
    if isinstance(value, slice):  # a constant from Python 3.14 on
        return _hash(kind, *(_of_value(where, one, names, called) for one in (value.start, value.stop, value.step)))
    if isinstance(value, set | frozenset):
        return _hash(kind, *sorted(_of_value(where, one, names, called) for one in value))
    if isinstance(value, Mapping):
        of = {_of_value(where, key, names, called): _of_value(where, one, names, called) for key, one in value.items()}
        return _hash(kind, repr(sorted(of.items())))
    if isinstance(value, ModuleType):
        return _of_module(value, names, called)
    if isinstance(value, type):
        return _hash("class", value.__module__, value.__qualname__, *_fields(value))
    if isinstance(value, BuiltinFunctionType | np.ufunc):
        return _hash(kind, str(getattr(value, "__module__", "")), value.__name__)
    return _of_others(where, kind, value, names, called)


def _of_module(module: ModuleType, names: set[str], called: list[Any]) -> str:
    """What a function may take out of it, if it is ours: as kernels, such modules lie in one package."""
    if module.__name__.partition(".")[0] != __name__.partition(".")[0]:
        return _hash("module", module.__name__)
    used = {name: vars(module)[name] for name in sorted(names & vars(module).keys())}
    values = (_of_value(f"{module.__name__}.{name}", value, names, called) for name, value in used.items())
    return _hash("module", module.__name__, *used, *values)


def _fields(record: type) -> list[str]:
    """Of a named tuple, with what they hold."""
    if not hasattr(record, "_fields"):
        return []
    made: Any = record
    hints = get_type_hints(record, include_extras=True)
    return [f"{name}: {hints.get(name)!r} = {made._field_defaults.get(name)!r}" for name in made._fields]


def _of_others(where: str, kind: str, value: Any, names: set[str], called: list[Any]) -> str:
    """A function of Python's, which the compiler looks into in a way of its own."""
    function = getattr(value, "_defn", value)
    if not isinstance(function, FunctionType):
        if kind.partition(".")[0] in ("numpy", "numba", "llvmlite"):
            return _hash(kind, str(value))
        raise TypeError(
            f"{where} is a {kind}, of which it is not known when it is another: a kernel names numbers, strings, "
            f"tuples, arrays, records, modules and kernels; put it in one of these, or have {__name__} know it"
        )
    if function.__module__.partition(".")[0] != __name__.partition(".")[0]:
        return _hash(kind, function.__module__, function.__qualname__)
    closed = [cell.cell_contents for cell in function.__closure__ or ()]
    inside = _of_value(where, closed, names, called)
    return _hash(kind, function.__qualname__, _of_file(function.__code__.co_filename), inside)


@cache
def _of_file(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def _hash(*parts: str) -> str:
    return hashlib.sha256("".join(f"{len(part)} {part}" for part in parts).encode()).hexdigest()
