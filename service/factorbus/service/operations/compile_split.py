"""Which kernel comes next, in each of several processes that compile all of them together.

A process works out a function that several kernels call once, and every process that needs it does.  So each keeps to
kernels of which it knows much already, and away from those of which another does.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any


class CompileSplit:
    """What is taken and what is left.  claims: a folder where the first process makes a file with a kernel's name.

    functions: of every kernel those that it calls, directly or not, and itself, with how large they are.
    """

    def __init__(self, claims: Path, functions: Mapping[str, Mapping[Any, int]]) -> None:
        self._claims, self._left = claims, dict(functions)
        self._ours: set[Any] = set()
        self._theirs: set[Any] = set()

    def __iter__(self) -> Iterator[str]:
        """The names of those that this process takes."""
        while True:
            self._look()
            if not self._left:
                return
            name = max(self._left, key=self._worth)
            with suppress(FileExistsError):
                (self._claims / name).touch(exist_ok=False)
                self._ours.update(self._left.pop(name))
                yield name

    def _look(self) -> None:
        """What others have taken meanwhile."""
        for claim in self._claims.iterdir():
            self._theirs.update(self._left.pop(claim.name, ()))

    def _worth(self, name: str) -> tuple[int, int]:
        """What of it is known here, less what is known elsewhere alone; then its size, to have large ones early."""
        sizes: Counter[str] = Counter()
        for function, size in self._left[name].items():
            whose = "ours" if function in self._ours else "theirs" if function in self._theirs else "new"
            sizes[whose] += size
        return sizes["ours"] - sizes["theirs"], sizes.total()


def functions_of(kernel: Any) -> dict[Callable[..., Any], int]:
    """All that is compiled with `kernel`, itself included, and not what it calls by its address: each function's length
    in bytes of Python's code."""
    found: dict[Callable[..., Any], int] = {}
    open_ = [kernel.py_func]
    while open_:
        function = open_.pop()
        if function not in found:
            codes = list(_codes(function.__code__))
            found[function] = sum(len(code.co_code) for code in codes)
            open_ += (called for code in codes for called in _called(code, function.__globals__))
    return found


def _codes(code: CodeType) -> Iterator[CodeType]:
    """It, and what is defined inside."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def _called(code: CodeType, names: Mapping[str, Any]) -> Iterator[Callable[..., Any]]:
    """The kernels and parts that it names, by themselves or in a module."""
    for name in code.co_names:
        thing = names.get(name)
        inside = [vars(thing).get(other) for other in code.co_names] if isinstance(thing, ModuleType) else []
        for one in (thing, *inside):
            function = getattr(one, "py_func", None)
            if function is not None and not getattr(one, "factorbus_shared", False):
                yield function
